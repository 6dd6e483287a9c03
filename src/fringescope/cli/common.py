"""What every verb shares: options, progress on stderr, one JSON object on stdout, settings from file and --set."""

from __future__ import annotations

import json
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Annotated, Any, Self, TypeVar

import typer

from fringescope import settings as tree
from fringescope.errors import CaptureError, UsageError

if TYPE_CHECKING:
    from rich.progress import Progress as Bars
    from rich.progress import TaskID

    from fringescope.types import PixelFormat, Response

T = TypeVar("T")

INTERRUPTED = threading.Event()  #: set once somebody asked to stop

Out = Annotated[Path, typer.Option("--out", help="Where the result goes: a new or empty folder.", show_default=False)]
Force = Annotated[bool, typer.Option("--force", help="Replace a result of the same kind that is there already.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout.")]
SettingsFile = Annotated[
    Path | None, typer.Option("--settings", metavar="FILE.yml", help="Thresholds; see `fringescope settings`.")
]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="SECTION.NAME=VALUE", help="One threshold; may be repeated.")
]
Views = Annotated[
    list[str] | None, typer.Option("--view", metavar="CAMERA", help="Only this camera's view; may be repeated.")
]

ResponseFile = Annotated[
    Path | None, typer.Option("--response", metavar="FILE.json", help="Free the phases from what `response` measured.")
]


def load_response(file: Path | None) -> Response | None:
    """The response in a file, or none. Raises FormatError."""
    from fringescope import store

    return None if file is None else store.read_response(file)


def load_settings(file: Path | None, changes: Iterable[str] | None) -> tree.Settings:
    """Defaults, then the file, then each `section.name=value`. Raises UsageError."""
    s = tree.Settings()
    if file is not None:
        try:
            text = file.read_text(encoding="utf-8")
        except (OSError, ValueError) as e:
            raise UsageError(f"--settings {file}: cannot read: {getattr(e, 'strerror', None) or e}") from e
        s = tree.from_yaml(text, s)
    for change in changes or ():
        key, eq, value = change.partition("=")
        section, dot, name = key.strip().partition(".")
        if not (eq and dot and section and name):
            raise UsageError(f"--set {change}; needed SECTION.NAME=VALUE, as in denoise.min_modulation=5")
        import yaml

        try:
            parsed = yaml.safe_load(value)
        except yaml.YAMLError as e:
            raise UsageError(f"--set {change}: the value is not a number, word or true/false") from e
        s = tree.from_dict({section: {name: parsed}}, s)
    return s


def numbers(text: str, option: str, kind: Callable[[str], T]) -> tuple[T, ...]:
    """ "4,4,8" to numbers. Raises UsageError naming the option."""
    try:
        out = tuple(kind(t) for t in text.replace(" ", "").split(",") if t)
    except ValueError:
        out = ()
    if not out:
        raise UsageError(f"{option} {text}; needed numbers with commas between")
    return out


def size(text: str, option: str) -> tuple[int, int]:
    """ "912x1140" to (912, 1140). Raises UsageError."""
    w, x, h = text.lower().partition("x")
    if not (x and w.isdigit() and h.isdigit() and 0 < int(w) < 10**6 and 0 < int(h) < 10**6):
        raise UsageError(f"{option} {text}; needed WIDTHxHEIGHT, as in 912x1140")
    return int(w), int(h)


def pixel_format(name: str | None) -> PixelFormat | None:
    """A GenICam pixel format by name. Raises UsageError."""
    from fringescope.types import PixelFormat

    if name is None:
        return None
    for f in PixelFormat:
        if f.value.lower() == name.lower():
            return f
    raise UsageError(f"--pixel-format {name}; needed one of {', '.join(f.value for f in PixelFormat)}")


def say(text: str) -> None:
    """A line for people, on stderr: stdout is for results."""
    print(text, file=sys.stderr, flush=True)


def emit(result: Mapping[str, Any], as_json: bool, lines: Iterable[str]) -> None:
    """The result: one JSON object, or lines for people."""
    if as_json:
        from fringescope.store import plain

        print(json.dumps(plain(result), allow_nan=False))
    else:
        for line in lines:
            print(line)


class Progress:
    """Progress on stderr: bars on a terminal, else a line when a stage that takes over a second has ended, and one
    every `TELL_S` seconds on how far a long stage has come.

    Call it with (stage, done, total) as work goes on. Use as a context manager.
    """

    TELL_S = 10.0

    def __init__(self) -> None:
        self._bars: Bars | None = None
        self._tasks: dict[str, TaskID] = {}
        self._begun: dict[str, float] = {}
        self._told: dict[str, float] = {}
        self._current = ""
        self.times_s: dict[str, float] = {}

    def __enter__(self) -> Self:
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

            columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %")
            self._bars = Progress(*columns, TimeElapsedColumn(), console=Console(stderr=True), transient=True)
            self._bars.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        if self._bars is not None:
            self._bars.stop()

    def __call__(self, stage: str, done: float, total: float) -> None:
        """Stage `stage` has done `done` of `total`. Raises KeyboardInterrupt once somebody asked to stop."""
        self._check()
        now = time.perf_counter()
        begun = self._begun.setdefault(stage, now)
        ended = done >= total
        if ended and stage not in self.times_s:
            self.times_s[stage] = now - begun
            if self._bars is None and now - begun > 1:
                say(f"{stage}: {now - begun:.1f} s")
        elif self._bars is None and done > 0 and now - self._told.get(stage, begun) > self.TELL_S:
            self._told[stage] = now
            say(f"{stage}: {done:,.0f} of {total:,.0f}")
        if self._bars is not None:
            if stage not in self._tasks:
                self._tasks[stage] = self._bars.add_task(stage, total=total)
            self._bars.update(self._tasks[stage], completed=done, total=total)

    def of(self, stage: str) -> Callable[[int, int], None]:
        """Tells this of one stage, for work that knows how much is done, of how much."""
        return lambda done, total: self(stage, done, total)

    def _check(self) -> None:
        if INTERRUPTED.is_set():
            raise KeyboardInterrupt

    def share(self, what: str, share: float) -> None:
        """`what` begins when `share` (0 to 1) of the whole is done: the form in which `pipeline` tells."""
        self._check()
        now = time.perf_counter()
        if self._bars is not None:
            if "" not in self._tasks:
                self._tasks[""] = self._bars.add_task(what, total=1.0)
            self._bars.update(self._tasks[""], description=what, completed=share)
        elif self._current and now - self._begun[self._current] > 1:
            say(f"{self._current}: {now - self._begun[self._current]:.1f} s")
        self._begun[what], self._current = now, what

    def track(self, items: Iterable[T], stage: str, total: int) -> Iterator[T]:
        """The items, counted as they go by."""
        self(stage, 0, total)
        for i, item in enumerate(items, 1):
            yield item
            self(stage, i, total)

    def run(self, stage: str, work: Callable[[], T]) -> T:
        """One piece of work as a stage."""
        self(stage, 0, 1)
        out = work()
        self(stage, 1, 1)
        return out


@contextmanager
def until_interrupted() -> Iterator[Callable[[], bool]]:
    """Ctrl-C is the way to end here: it interrupts nothing, and the question whether somebody asked is answered."""
    asked = threading.Event()

    def ask(_number: int, _frame: FrameType | None) -> None:
        asked.set()

    here = threading.current_thread() is threading.main_thread()
    before = {n: signal.signal(n, ask) for n in (signal.SIGINT, signal.SIGTERM)} if here else {}
    try:
        yield asked.is_set
    finally:
        for n, handler in before.items():
            signal.signal(n, handler)


def existing(path: Path, what: str) -> Path:
    """`path` if it is there. Raises CaptureError."""
    if not path.exists():
        raise CaptureError(f"{path}: not found; needed {what}")
    return path
