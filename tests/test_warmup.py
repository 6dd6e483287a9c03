"""After `fringescope warmup` no process compiles: not for one view, nor five, nor 16 bits, nor the coarse surface."""

import json
import subprocess
import sys

import pytest

#: Runs command lines and counts what Numba compiles meanwhile; one thing of its own shows that the count works.
COUNT = """
import json, sys
import numba
from numba.core import event
from fringescope.cli import run

compiled = []

class Listener(event.Listener):
    def on_start(self, e): compiled.append(e.data["dispatcher"].py_func.__qualname__)
    def on_end(self, e): pass

event.register("numba:compile", Listener())
numba.njit(lambda x: x + 1)(1)
status = [run(line) for line in json.loads(sys.argv[1])]
if len(sys.argv) > 2:
    from fringescope import pipeline, store
    from fringescope.settings import from_dict
    views = store.view_inputs(store.read_capture(sys.argv[2]))
    pipeline.preview(views, store.read_rig(sys.argv[3]), from_dict({"mesh": {"preview_pixels": 4000}}))
print("counted", json.dumps([status, compiled]))
"""


def compiled_by(lines, *preview):
    command = [sys.executable, "-c", COUNT, json.dumps(lines), *map(str, preview)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    told = [line for line in done.stdout.splitlines() if line.startswith("counted ")]
    assert told, done.stderr
    status, names = json.loads(told[0].removeprefix("counted "))
    assert status == [0] * len(lines), done.stderr
    assert names[0] == "<lambda>"
    return names[1:]


@pytest.fixture(scope="module", autouse=True)
def _warm():
    subprocess.run([sys.executable, "-m", "fringescope", "warmup"], check=True, capture_output=True)


@pytest.mark.parametrize("preset", ["single", "pair", "five"])
def test_a_simulated_capture_compiles_nothing(tmp_path, preset):
    capture, out = str(tmp_path / "capture"), str(tmp_path / "scan")
    simulate = [sys.executable, "-m", "fringescope", "simulate", "tissue-domed", "--out", capture]
    subprocess.run([*simulate, "--preset", preset, "--scale", "0.05"], check=True, capture_output=True)
    rig = str(tmp_path / "capture" / "truth" / "rig.json")
    lines = [["reconstruct", capture, "--rig", rig, "--out", out, "--all-points", "--json"],
             ["decode", capture, "--out", str(tmp_path / "decoded"), "--json"]]  # fmt: skip
    assert compiled_by(lines, capture, rig) == []


def test_rendered_tissue_compiles_nothing(shared, tmp_path):
    folder = shared / "data" / "rendered-small"
    rig = folder / "truth" / "rig.json"
    line = ["reconstruct", str(folder / "tissue"), "--rig", str(rig), "--out", str(tmp_path / "scan"), "--json"]
    assert compiled_by([line], folder / "tissue", rig) == []
