"""Devices by protocol: `base` says what they are, `simulated` and `replay` stand in for them."""
