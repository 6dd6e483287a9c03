"""The digital twin: a world with exact truth. It shares no maths with the code that it tests."""
