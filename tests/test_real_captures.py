"""Captures that nobody of this project made: other projectors, cameras, steps, codes and bit depths."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.io

from fringescope import phase, pipeline, store
from fringescope.settings import Settings


@pytest.fixture(scope="module")
def skull_truth(shared: Path) -> np.ndarray:
    """The author's own Gray-code cloud, (1352, 1688, 3), camera frame, mm."""
    return np.asarray(scipy.io.loadmat(shared / "data" / "slstudio" / "skull-author-cloud.mat")["xyz"])


def depth_difference(shared: Path, capture: str, truth: np.ndarray) -> tuple[np.ndarray, int]:
    folder = shared / "data" / "slstudio"
    view = store.view_inputs(store.read_capture(folder / capture))[0]
    _, grid = pipeline.scan_view(view, store.read_rig(folder / "rig-author.json"), Settings())
    d = grid.xyz[..., 2] - truth[..., 2]
    return d[np.isfinite(d)], int(grid.valid.sum())


def test_skull(shared: Path, skull_truth: np.ndarray) -> None:
    d, points = depth_difference(shared, "skull", skull_truth)
    assert points > 200_000
    assert len(d) > 70_000
    assert abs(np.median(d)) <= 0.1
    assert 1.4826 * np.median(np.abs(d - np.median(d))) <= 0.45
    # one wrong order is a sixteenth of the field, 6 mm in depth or more: none is passed on
    assert np.mean(np.abs(d) > 5) < 1e-3


def test_skull_in_gray_code(shared: Path, skull_truth: np.ndarray) -> None:
    d, points = depth_difference(shared, "skull-gray", skull_truth)
    assert points > 50_000
    assert abs(np.median(d)) <= 1.0
    assert np.percentile(np.abs(d), 99) <= 2.0


def test_mug_decodes_by_beat_and_gray_code(shared: Path) -> None:
    view = store.view_inputs(store.read_capture(shared / "data" / "gamma-mug" / "object2"))[0]
    s = Settings()
    decoded = pipeline.decode_view(view, s)
    ok = decoded.reasons == 0
    assert ok.mean() > 0.5
    u, v = phase.projector_coordinates(decoded)
    assert np.isnan(v).all()
    fine, coarse = sorted(decoded.sets, key=lambda w: -w.g[0])
    again = (coarse.phase / (2 * np.pi) + np.rint(u * coarse.g[0] - coarse.phase / (2 * np.pi))) / coarse.g[0]
    # what is known of it: its strong gamma makes the two frequencies disagree by 4.2 to 4.4 px (median)
    assert 3.5 <= np.median(np.abs(u - again)[ok]) <= 4.8
    # orders are whole: nowhere a jump of a period inside a row of the flat cardboard
    step = np.abs(np.diff(u, axis=1))[ok[:, 1:] & ok[:, :-1]]
    assert np.mean(step > 20) < 2e-3
    assert fine.steps == coarse.steps == 3


def test_sixteen_bit_stack_decodes(shared: Path, tmp_path: Path) -> None:
    from fringescope.cli import run

    stack = shared / "data" / "stack-16bit" / "ex_stack.tif"
    assert run(["decode", str(stack), "--steps", "3", "--axis", "Z", "--out", str(tmp_path / "out")]) == 0
    files = {p.name for p in (tmp_path / "out").rglob("*.tif")}
    assert {"phase_0.tif", "modulation.tif", "background.tif", "u.tif", "v.tif"} <= files
