"""The command line: each verb a few lines. `main` is the console script, `run` the same for tests."""

from fringescope.cli import capturing, demo, scanning
from fringescope.cli.app import app, main, run

__all__ = ["app", "capturing", "demo", "main", "run", "scanning"]
