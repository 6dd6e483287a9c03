"""What a cold start goes without: libraries and kernels that nobody asked for. Counts, no times."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import pytest

from fringescope import cli

HEAVY = {"numba", "cv2", "matplotlib", "scipy", "tifffile", "pydantic", "numpy", "yaml"}
#: what a reconstruct has no use for; the last is what Numba imports before it compiles
UNUSED = {"matplotlib", "scipy.linalg", "tifffile", "numba.np.arraymath"}
MOST_KERNELS = 80  #: each costs a few milliseconds; a reconstruct loads some 70


def imported_by(code: str, *args: str, **env: str) -> Any:
    """What the code prints last, as JSON."""
    command = [sys.executable, "-c", textwrap.dedent(code), *args]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, **env})
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("line", [["--help"], ["--version"]])
def test_help_imports_nothing_heavy(line: list[str]) -> None:
    code = """
        import json, sys
        from fringescope.cli import run
        run(sys.argv[1:])
        print(json.dumps([m for m in sys.modules]))
        """
    assert HEAVY & set(imported_by(code, *line)) == set()


def test_the_table_of_verbs_says_what_the_verbs_say() -> None:
    table = importlib.import_module("fringescope.cli.app").VERBS
    commands = cli.whole().commands
    assert set(commands) == set(table)
    for verb, (module, text) in table.items():
        assert commands[verb].callback.__module__ == f"fringescope.cli.{module}"
        assert " ".join(commands[verb].help.split("\n\n")[0].split()) == text


def test_a_reconstruct_loads_few_kernels_and_no_more_libraries(shared: Path, tmp_path: Path) -> None:
    code = """
        import json, sys
        from fringescope.cli import run
        status = run(sys.argv[1:])
        from numba.core.dispatcher import Dispatcher
        import gc
        kernels = sum(len(d.overloads) for d in gc.get_objects() if isinstance(d, Dispatcher))
        print(json.dumps([status, kernels, sorted(sys.modules)]))
        """
    folder = shared / "data" / "rendered-small"
    line = ["reconstruct", str(folder / "tissue"), "--rig", str(folder / "truth" / "rig.json"), "--out"]
    imported_by(code, *line, str(tmp_path / "first"))  # compiles what is not there yet
    status, kernels, modules = imported_by(code, *line, str(tmp_path / "second"))
    assert status == 0
    assert UNUSED & set(modules) == set()
    assert 20 < kernels <= MOST_KERNELS


# ------------------------------------------------------------------------------------------- kernels out of the cache

KERNELS = """
import json, sys
import numpy as np
from fringescope import jit
from fringescope.jit import linked as inside
from numba.core import event

if "old" in sys.argv:
    jit.TRIED = ("0.1.",)

@jit.njit(error_model="numpy")
def square(x):
    return x * x

@jit.njit
def refuse(x):
    if x < 0:
        raise ValueError("negative")
    return np.sort(np.full(3, x))

if "full" in sys.argv:
    def no_room(*_): raise OSError(28, "No space left on device")
    inside.FunctionCache.save_overload = no_room
compiled = []
class Listener(event.Listener):
    def on_start(self, e): compiled.append(e.data["dispatcher"].py_func.__name__)
    def on_end(self, e): pass
event.register("numba:compile", Listener())
if "numbas" in sys.argv:
    inside._as_expected = lambda parts: False
out = [square(3.0), refuse(2.0).tolist()]
try:
    refuse(-1.0)
except ValueError as e:
    out.append(str(e))
linked = [type(c.library).__name__ for f in (square, refuse) for c in f.overloads.values()]
first, ready = list(compiled), "numba.np.arraymath" in sys.modules
if "calls" in sys.argv:
    @jit.njit
    def cube(x):
        return square(x) * x
    out.append(cube(2.0))
print(json.dumps([out, first, linked, ready]))
"""


def test_a_kernel_out_of_the_cache_is_the_kernel(tmp_path: Path) -> None:
    script, cache = tmp_path / "kernels.py", {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    script.write_text(KERNELS)
    code = f"import runpy; runpy.run_path({str(script)!r})"
    new, compiled, _, ready = imported_by(code, **cache)
    assert compiled[:1] == ["square"]
    assert "refuse" in compiled
    assert ready
    assert new == [9.0, [2.0, 2.0, 2.0], "negative"]
    full = imported_by(code, "full", NUMBA_CACHE_DIR=str(tmp_path / "full"))
    assert full[0] == new  # a disk without room: compiled, not kept
    again = imported_by(code, **cache)
    assert again == [new, [], ["_Library", "_Library"], False]  # linked, and Numba was not made ready to compile
    called, compiled, *_ = imported_by(code, "calls", **cache)
    assert called == [*new, 8.0]  # a new kernel calls one out of the cache
    assert compiled == []
    numbas = imported_by(code, "numbas", **cache)
    assert numbas == [new, [], ["JITCodeLibrary", "JITCodeLibrary"], True]  # what is not as expected is left to Numba
    for damage in (b"", b"no kernel at all", b"\x80\x04K\x01."):
        for kind in ("nbi", "nbc"):
            for file in Path(cache["NUMBA_CACHE_DIR"]).rglob(f"*.{kind}"):
                file.write_bytes(damage)
            assert imported_by(code, **cache)[0] == new  # compiled again
    assert imported_by(code, **cache) == again
    assert imported_by(code, "old", **cache) == numbas  # and so is all of a version that was not tried
