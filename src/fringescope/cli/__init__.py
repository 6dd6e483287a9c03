"""The command line: each verb a few lines. `main` is the console script, `run` the same for tests."""

from fringescope.cli.app import app, main, run
from fringescope.cli.boards import board
from fringescope.cli.calibrating import calibrate, verify
from fringescope.cli.capturing import devices, import_, patterns, settings_, simulate
from fringescope.cli.responding import response
from fringescope.cli.scanning import decode, evaluate, export, reconstruct
from fringescope.cli.showing import demo
from fringescope.cli.timing import bench, warmup

__all__ = [
    "app",
    "bench",
    "board",
    "calibrate",
    "decode",
    "demo",
    "devices",
    "evaluate",
    "export",
    "import_",
    "main",
    "patterns",
    "reconstruct",
    "response",
    "run",
    "settings_",
    "simulate",
    "verify",
    "warmup",
]
