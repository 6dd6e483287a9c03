"""The benchmark runs, says what others read, and is honest about what is missing. Times themselves are not tested."""

import json
import sys

import pytest

from fringescope import bench, cli

NEEDED = {
    "copy_floor_s", "decode_triangulate_over_copy", "three_views_over_copy", "peak_memory_over_io",
    "fringes_fast_over_ours",
}  # fmt: skip


def test_the_command_gives_what_others_read(capsys, monkeypatch):
    monkeypatch.setattr(bench.importlib.util, "find_spec", lambda _name: None)
    assert cli.run(["bench", "--megapixels", "0.05", "--repeat", "1", "--whole", "--json"]) == 0
    out = json.loads(capsys.readouterr().out)
    assert set(out) >= NEEDED
    assert out["fringes_fast_over_ours"] is None
    assert "not here" in out["others_s"]["fringes"]
    assert all(out[name] > 0 for name in NEEDED - {"fringes_fast_over_ours"})
    assert out["peak_memory_over_io"] > 1
    assert out["surface_s"] > 0
    assert out["coarse_surface_s"] > 0
    lines = bench.lines(out)
    assert "copy floor" in lines[0]
    assert any("x copy" in line for line in lines)


def test_others_are_timed_by_the_interpreter_that_has_them(tmp_path):
    package = tmp_path / "fringes"
    package.mkdir()
    (package / "__init__.py").write_text(
        "import numpy as np\n"
        "class Fringes:\n"
        "    def __init__(self, X, Y, mode): self.T = 16\n"
        "    def decode(self, frames): assert frames.shape[0] == 16 and frames.dtype == np.uint8\n"
    )
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\nPYTHONPATH={tmp_path} exec {sys.executable} "$@"\n')
    python.chmod(0o755)
    out = bench.measure(0.02, 1, peer_python=python)
    assert out["fringes_fast_over_ours"] > 0
    assert out["others_over_ours"]["fringes precise"] > 0


@pytest.mark.parametrize(
    "line",
    [
        ["--megapixels", "0"],
        ["--repeat", "0"],
        ["--megapixels", "0.02", "--repeat", "1", "--peer-python", "/nowhere/python"],
    ],
)
def test_wrong_usage(line, capsys):
    assert cli.run(["bench", *line]) == 2
    assert capsys.readouterr().err.strip().splitlines()[-1].startswith("fringescope: ")


def test_frames_are_as_described():
    rig, (view,) = bench.views_of(0.1, 1)
    lens = rig.cameras[0].lens
    frames = [f for _, f in view.frames]
    assert len(frames) == 16
    assert all(f.shape == (lens.height, lens.width) for f in frames)
    dark = sum(f.astype(float) for f in frames) / 16 < 10
    assert 0.15 < dark.mean() < 0.25
    assert lens.distortion.any()
    assert rig.projector.lens.distortion.any()


def test_warmup(capsys):
    assert cli.run(["warmup", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["points"] > 100
