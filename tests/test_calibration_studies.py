"""The studies behind calibration run, and say what they are there to say: in their quick form, on made-up sightings."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

STUDIES = Path(__file__).resolve().parents[1] / "benchmarks" / "calibration"


def run(name: str, out: Path) -> dict[str, Any]:
    command = [sys.executable, str(STUDIES / f"{name}.py"), "--quick", "--out", str(out / f"{name}.json")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env={**os.environ, "MPLBACKEND": "Agg"})
    assert done.returncode == 0, done.stderr
    assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    return dict(json.loads((out / f"{name}.json").read_text()))


def test_white_squares_are_read_where_they_are(tmp_path: Path) -> None:
    sweep = run("features", tmp_path)["sweeps"]["tilt_deg"]
    assert sweep["at"] == [0, 40]
    bias = {name: f["bias"] for name, f in sweep["features"].items()}
    ours, disc = bias["white square, ours"], bias["disc, centre of its picture"]
    assert max(ours) < 0.01
    assert min(bias["corner, phase of its pixels"]) > 5 * max(ours)
    # the centre of a disc's picture lies r^2 sin(tilt) / distance off; the projector, 0.0504 mm a unit, sees it tilted
    mm = 2.5**2 * math.sin(math.radians(40)) / 500
    assert disc[1] == pytest.approx(mm / 0.0504 * math.cos(math.radians(40)), rel=0.2)
    assert disc[1] > 3 * disc[0]


def test_a_joint_adjustment_makes_views_agree(tmp_path: Path) -> None:
    ways = run("joint_or_single", tmp_path)["ways"]
    apart = {name: w["between views, um"] for name, w in ways.items()}
    assert apart["the true rig"] < 1e-6
    alone = min(v for name, v in apart.items() if name.startswith("OpenCV"))
    assert apart["joint, samples"] < apart["joint, corners"] < alone / 2
    # and the corners' residuals do not tell them apart
    rms = [w["rms of corners, px"] for name, w in ways.items() if name != "the true rig"]
    assert max(rms) < 1.1 * min(rms)


def test_more_poses_are_better(tmp_path: Path) -> None:
    poses = run("how_many_poses", tmp_path)["poses"]
    few, many = poses["3"], poses["6"]
    assert few["focal sigma, ppm"][0] > 1.2 * many["focal sigma, ppm"][0]
    assert sum(few["points, um"]) / len(few["points, um"]) > many["points, um"][0]
    assert max(few["left out, um"]) < 10
