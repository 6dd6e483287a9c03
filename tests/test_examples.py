"""The examples run as they are written, each in an interpreter of its own, and say what they promise."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
NUMBERED = sorted(p.name for p in EXAMPLES.glob("*.py"))


def run(name: str, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "error", str(EXAMPLES / name), *arguments],
        capture_output=True, text=True, timeout=300, env={**os.environ, "MPLBACKEND": "Agg"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


def test_they_are_numbered_without_a_gap() -> None:
    assert [int(name[:2]) for name in NUMBERED] == list(range(1, len(NUMBERED) + 1))


def test_scan_in_one_call(tmp_path: Path) -> None:
    said = run("01_scan_in_one_call.py", str(tmp_path / "out"), "0.04")
    assert len(re.findall(r"^camera\d: \d+ of \d+ pixels", said, re.M)) == 3
    assert (tmp_path / "out" / "cloud.ply").read_bytes().startswith(b"ply\n")
    assert (tmp_path / "out" / "surface.glb").read_bytes().startswith(b"glTF")


def test_scan_while_it_records(tmp_path: Path) -> None:
    said = run("05_scan_while_it_records.py", str(tmp_path / "out"), "0.04")
    assert re.match(r"coarse surface: \d+ triangles\n\d+ points in ", said)
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"coarse.glb", "cloud.ply", "surface.glb"}


def test_lines_on_the_tissue(tmp_path: Path) -> None:
    said = run("06_lines_on_the_tissue.py", str(tmp_path / "out"), "0.05")
    assert re.search(r"^cut: \d+\.\d mm, (9\d|100)% visible, expected error \d+ um$", said, re.M)
    landed = re.search(r"^cut: landed (\d+) um", said, re.M)
    assert landed is not None
    assert int(landed[1]) < 60
    assert (tmp_path / "out" / "preview-camera3.png").exists()


def test_a_case_at_the_hub(tmp_path: Path) -> None:
    pytest.importorskip("fastapi", reason="needs fringescope[server]")
    said = run("07_a_case_at_the_hub.py", str(tmp_path / "out"), "0.05")
    assert "projected; the expert sees it, too: projecting\nthat is enough: dark\n" in said
    assert (tmp_path / "out" / "projected.jpg").read_bytes()[:2] == b"\xff\xd8"


def test_the_parts_take_away_and_never_add() -> None:
    left = [int(n) for n in re.findall(r"leaves (\d+) of", run("02_the_parts.py", "0.04"))]
    assert len(left) == 5
    assert left == sorted(left, reverse=True)
    assert left[-1] > 5000


def test_planning_prefers_tilted_fringes_for_the_oblique_cameras() -> None:
    said = run("03_plan_before_you_capture.py")
    sigma = {(m[1].strip(), m[2]): float(m[3]) for m in re.finditer(r"(.+?) (camera\d): .*sigma ([\d.]+) um", said)}
    for camera in ("camera2", "camera3"):
        assert sigma["Table I, horizontal", camera] > 1.5 * sigma["Table I, tilted", camera]
    assert sigma["Table I, horizontal", "camera1"] == pytest.approx(sigma["Table I, tilted", "camera1"], rel=0.02)


def test_your_own_arrays_come_within_their_noise() -> None:
    rms, predicted = map(float, re.findall(r"\d+\.\d+", run("04_your_own_arrays.py")))
    assert rms == pytest.approx(predicted, rel=0.1)
