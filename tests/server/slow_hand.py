"""A child process that takes its time: what tests of cancelling need."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fringescope.server.processes.child import Call


def sleep(_call: Call, seconds: float, note: str) -> str:
    """Notes down that it has begun, and returns after so long."""
    with Path(note).open("a") as f:
        f.write("begun\n")
    time.sleep(seconds)
    return note


class Hand:
    """Its calls."""

    def __init__(self, _emit: Callable[[dict[str, Any]], None]) -> None:
        self.calls: dict[str, Callable[..., Any]] = {"sleep": sleep}
        self.urgent: dict[str, Callable[..., Any]] = {}

    def ended(self) -> None:
        """Nothing to tidy up."""
