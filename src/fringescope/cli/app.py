"""The command itself: its verbs, exit status 0, 1 or 2, and one line on stderr for whatever goes wrong."""

from __future__ import annotations

import gc
import importlib
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from types import FrameType
from typing import Annotated, Any, NoReturn

import typer
import typer.core
import typer.main

from fringescope import __version__
from fringescope.cli.common import INTERRUPTED
from fringescope.errors import FringescopeError, UsageError

#: verb -> the module that defines it, imported when the verb is called; how its help begins
VERBS: dict[str, tuple[str, str]] = {
    "board": (
        "boards",
        "A calibration board to print at true scale, with measuring bars and its board.json beside it.",
    ),
    "calibrate": ("calibrating", "Board captures to a calibrated rig, with the evidence to trust it."),
    "verify": ("calibrating", "Is this rig still true? Judged from one capture, with or without a board."),
    "simulate": ("capturing", "A capture of the simulated instrument, with its exact truth in truth/."),
    "import": (
        "capturing",
        "Somebody's loose images, or a TIFF stack, to a capture, with a preview and a proof that the order is right.",
    ),
    "patterns": (
        "capturing",
        "The images to project for a rig, as the device needs them, with the plan that they follow.",
    ),
    "devices": ("capturing", "The devices that can be opened, by URI."),
    "settings": ("capturing", "Every threshold with its value, unit and meaning, as the YAML that --settings takes."),
    "response": (
        "responding",
        "Measures the response of projector and camera (gamma, saturation) and tells whether phases "
        "need its correction.",
    ),
    "reconstruct": (
        "scanning",
        "Fringe images to a clean, coloured, fused surface: scan.json, cloud.ply, surface.glb.",
    ),
    "decode": (
        "scanning",
        "Phase, modulation, background, projector coordinates and reasons per pixel, without a rig.",
    ),
    "evaluate": (
        "scanning",
        "Fits a plane or spheres and tells how good the points are, as in section IV of the paper.",
    ),
    "export": (
        "scanning",
        "A scan in other people's formats: the surface (stl, obj, 3mf, glb) or the points (pcd, e57, ply), in mm.",
    ),
    "guide": (
        "guiding",
        "Guidelines to the picture that the projector shows, and what of them is visible and how exact.",
    ),
    "carry": (
        "guiding",
        "Guidelines of one scan carried over to the next by registration, for the operator to look at and decide.",
    ),
    "selftest": (
        "guiding",
        "Projects a cross grid on the calibration board and measures where its lines land: after each calibration.",
    ),
    "compare": (
        "comparing",
        "Two scans, before and after a cut: what was removed, where, how surely, and how far from the guideline.",
    ),
    "demo": (
        "showing",
        "The simulated instrument scans a wet specimen: capture, scan, error map against the truth, "
        "rendered pictures.",
    ),
    "serve": (
        "serving",
        "The hub: cases, shared drawing, and the instrument, for the operator here and experts anywhere.",
    ),
    "person": (
        "serving",
        "Accounts of a hub that does not run just now; a password is asked for, or read from a pipe.",
    ),
    "audit": (
        "auditing",
        "A hub's log, judged: was any event altered, removed or added? Signed checkpoints of it; it may run meanwhile.",
    ),
    "backup": (
        "keeping",
        "All of a hub, kept elsewhere; it may run meanwhile. Keep it as safe as the hub: patients and keys are in it.",
    ),
    "restore": ("keeping", "A hub's folder out of a backup; each file and the whole log are compared first."),
    "bench": (
        "timing",
        "Times a scan against a plain copy of the same memory and against other decoders, all in one run.",
    ),
    "watch": (
        "watching",
        "Is the specimen still where it was scanned? VALID, SUSPECT or STALE, in one line with the reason.",
    ),
    "warmup": ("timing", "Compiles the kernels for this processor now, so that no scan need; they are kept on disk."),
}


class _Verbs(typer.core.TyperGroup):
    """The verbs; each is imported when it is asked for."""

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ARG002 - as in the class above
        return list(VERBS)

    def get_command(self, ctx: Any, name: str) -> Any:  # noqa: ARG002
        if name in VERBS and name not in self.commands:
            importlib.import_module(f"fringescope.cli.{VERBS[name][0]}")
            one = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
            one.registered_commands = [i for i in app.registered_commands if _name(i) == name]
            self.commands[name] = typer.main.get_command(one)
        return self.commands.get(name)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        stubs: dict[str, Any] = {name: typer.core.TyperCommand(name, help=text) for name, (_, text) in VERBS.items()}
        typer.core.TyperGroup(name=self.name, commands=stubs).format_commands(ctx, formatter)


def _name(info: Any) -> str:
    return str(info.name or info.callback.__name__)


app = typer.Typer(
    name="fringescope",
    cls=_Verbs,
    help="Structured-light 3D imaging of tissue: fringe images to a clean, coloured surface.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

#: What the framework raises for a wrong command line, whichever library it builds on.
_ClickError: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")


def whole() -> Any:
    """The command with every verb in its `commands`, for who writes or reads its pages."""
    group: Any = typer.main.get_command(app)
    for name in VERBS:
        group.get_command(None, name)
    return group


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
    gc.set_threshold(20_000)  # most of what is made at first stays: it need not be looked through again and again
    sys.setswitchinterval(1e-3)  # who waits for the interpreter while a module is imported has little to do in it
    for number in (signal.SIGINT, signal.SIGTERM):  # either way temporary folders go
        signal.signal(number, _interrupt)
    status = run(sys.argv[1:])
    gc.freeze()  # nor when all of it goes
    sys.exit(status)
