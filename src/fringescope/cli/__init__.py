"""The command line: each verb a few lines. `main` is the console script, `run` the same for tests."""

from fringescope.cli.app import app, main, run, whole

__all__ = ["app", "main", "run", "whole"]
