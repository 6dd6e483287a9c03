"""The command itself: its verbs, exit status 0, 1 or 2, and one line on stderr for whatever goes wrong."""

from __future__ import annotations

import os
import signal
import sys
import traceback
from collections.abc import Sequence
from types import FrameType
from typing import Annotated, Any, NoReturn

import typer

from fringescope import __version__
from fringescope.cli.common import INTERRUPTED
from fringescope.errors import FringescopeError, UsageError

app = typer.Typer(
    name="fringescope",
    help="Structured-light 3D imaging of tissue: fringe images to a clean, coloured surface.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

#: What the framework raises for a wrong command line, whichever library it builds on.
_ClickError: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")


def _version(wanted: bool) -> None:
    if wanted:
        print(f"fringescope {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    debug: Annotated[bool, typer.Option("--debug", help="Show where an error came from.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Structured-light 3D imaging of tissue: fringe images to a clean, coloured surface."""


def _line(text: object) -> str:
    return " ".join(str(text).split())


def run(args: Sequence[str]) -> int:
    """Runs a command line and returns its exit status: 0 done, 1 the work failed, 2 wrong usage, 130 interrupted."""
    debug = "--debug" in args or bool(os.environ.get("FRINGESCOPE_DEBUG"))
    args = [a for a in args if a != "--debug"]
    try:
        result: Any = typer.main.get_command(app).main(args=list(args), prog_name="fringescope", standalone_mode=False)
        status = result if isinstance(result, int) else 0
        return _fail("interrupted; nothing was written", 130, debug) if status == 130 else status
    except (KeyboardInterrupt, typer.Abort):
        return _fail("interrupted; nothing was written", 130, debug)
    except UsageError as e:
        return _fail(e, 2, debug)
    except FringescopeError as e:
        return _fail(e, 1, debug)
    except _ClickError as e:
        message = str(e.format_message() if hasattr(e, "format_message") else e)
        if type(e).__name__ == "NoArgsIsHelpError":
            print(message or typer.main.get_command(app).get_help(typer.Context(typer.main.get_command(app))))
            return 2
        return _fail(f"{message} (see fringescope --help)", 2, debug)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except MemoryError:
        return _fail("out of memory; close other programs, or use smaller images", 1, debug)
    except OSError as e:
        where = f"{e.filename}: " if e.filename else ""
        return _fail(f"{where}{e.strerror or e}", 1, debug)
    except Exception as e:
        return _fail(f"{type(e).__name__}: {e}: this is a bug; run again with --debug and report it", 1, debug)


def _fail(message: object, status: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    print(f"fringescope: {_line(message)}", file=sys.stderr, flush=True)
    return status


def _interrupt(_number: int, _frame: FrameType | None) -> NoReturn:
    INTERRUPTED.set()  # a compiler's callback may swallow what is raised here: the next sign of progress raises again
    raise KeyboardInterrupt


def main() -> NoReturn:
    """The console script."""
    for number in (signal.SIGINT, signal.SIGTERM):  # either way temporary folders go
        signal.signal(number, _interrupt)
    sys.exit(run(sys.argv[1:]))
