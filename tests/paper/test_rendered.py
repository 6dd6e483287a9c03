"""The bar of the main job: rendered scenes with exact truth, reconstructed with the true rig and judged from outside.

The data come from an independent path tracer; the judge is tools/score.py beside them. Both lie outside this project.
"""

from __future__ import annotations

import importlib.util
import json
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from fringescope import export, geometry, pipeline, store
from fringescope.types import Rig, Scan

SCENES = ("plane", "sphere", "tissue")


@pytest.fixture(scope="module")
def rendered(shared: Path) -> Path:
    return shared / "data" / "rendered-small"


@pytest.fixture(scope="module")
def judge(shared: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("score", shared / "tools" / "score.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cache
def scan_of(folder: Path, scene: str) -> tuple[Scan, Rig]:
    rig = store.read_rig(folder / "truth" / "rig.json")
    views = store.view_inputs(store.read_capture(folder / scene))
    return pipeline.scan(views, rig, all_points=True), rig


def verdict(judge: ModuleType, folder: Path, scene: str, tmp_path: Path) -> dict[str, Any]:
    scan, _ = scan_of(folder, scene)
    assert scan.all_points is not None
    export.write_ply(scan.all_points, tmp_path / "cloud.ply")
    points, view, sigma = judge.read_ply(tmp_path / "cloud.ply")
    file = folder / "truth" / f"{scene}.json"
    truth = json.loads(file.read_text())
    if scene == "plane":
        return judge.plane(points, view, sigma, truth, False)
    if scene == "sphere":
        return judge.spheres(points, truth, False)
    return judge.tissue(points, view, truth, file.parent)


def test_plane(judge: ModuleType, rendered: Path, tmp_path: Path) -> None:
    r = verdict(judge, rendered, "plane", tmp_path)
    assert r["good"] >= 610_000
    assert 4.5 <= r["std_um"] <= 5.2
    assert abs(r["neighbour_correlation"]) <= 0.2
    assert abs(r["bias_um"]) <= 0.3
    assert r["form_um"] <= 0.5
    assert r["flying_ppm"] <= 30


def test_spheres(judge: ModuleType, rendered: Path, tmp_path: Path) -> None:
    r = verdict(judge, rendered, "sphere", tmp_path)
    small, large = r["spheres"]
    assert abs(large["fit_radius_error_um"]) <= 1
    assert abs(small["fit_radius_error_um"]) <= 4
    assert abs(r["centre_distance_error_um"]) <= 2
    assert large["residual_rms_um"] <= 8.3
    assert small["residual_rms_um"] <= 11.5
    assert large["points"] >= 45_000
    assert small["points"] >= 7_000
    assert r["flying_ppm"] <= 200


def test_tissue(judge: ModuleType, rendered: Path, tmp_path: Path) -> None:
    r = verdict(judge, rendered, "tissue", tmp_path)
    assert r["complete"] >= 0.97
    assert r["on_tissue"] >= 232_000
    assert r["std_um"] <= 7.5
    assert r["rms_um"] <= 11
    assert r["p99_um"] <= 42
    assert r["flying_ppm"] <= 200
    assert abs(r["neighbour_correlation"]) <= 0.2


def test_sigma_is_the_spread_of_the_error(rendered: Path) -> None:
    scan, rig = scan_of(rendered, "plane")
    truth = json.loads((rendered / "truth" / "plane.json").read_text())
    n, c = np.array(truth["normal"]), np.array(truth["point"])
    for grid in scan.grids:
        p = grid.xyz[grid.valid].astype(float)
        ray = p - geometry.centre(rig.cameras[grid.view].pose)
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        z = ((p - c) @ n) / (ray @ n) / grid.sigma[grid.valid]
        assert 0.9 <= 1.4826 * np.median(np.abs(z - np.median(z))) <= 1.1


def test_fused_plane_averages_the_views(rendered: Path) -> None:
    scan, rig = scan_of(rendered, "plane")
    truth = json.loads((rendered / "truth" / "plane.json").read_text())
    p = scan.cloud.xyz.astype(float)
    meet = np.ones(len(p), bool)
    for grid in scan.grids:  # where all three views meet: each has a valid pixel there
        uv = np.rint(geometry.project(rig.cameras[grid.view], p)).astype(int)
        h, w = grid.reasons.shape
        inside = (uv[:, 0] >= 3) & (uv[:, 1] >= 3) & (uv[:, 0] < w - 3) & (uv[:, 1] < h - 3)
        u, v = uv[:, 0].clip(0, w - 1), uv[:, 1].clip(0, h - 1)
        meet &= inside & (grid.reasons[v, u] == 0)
    e = (p[meet] - truth["point"]) @ np.array(truth["normal"])
    assert meet.sum() > 100_000
    assert 1.4826e3 * np.median(np.abs(e - np.median(e))) <= 3.3


def test_fused_cloud_is_one_layer(rendered: Path) -> None:
    """No point of another view within 0.05 mm sideways (across the viewing direction of the projector)."""
    from scipy.spatial import cKDTree

    for scene in SCENES:
        scan, rig = scan_of(rendered, scene)
        p, view = scan.cloud.xyz.astype(float), scan.cloud.view
        q = geometry.transform(rig.projector.pose, p)
        pairs = cKDTree(q[:, :2] / q[:, 2:] * np.median(q[:, 2])).query_pairs(0.05, output_type="ndarray")
        near = pairs[np.abs(q[pairs[:, 0], 2] - q[pairs[:, 1], 2]) < 0.5] if len(pairs) else pairs
        assert (view[near[:, 0]] != view[near[:, 1]]).sum() == 0, scene


def test_three_masks_alone_leave_a_tail(rendered: Path) -> None:
    """The fourth test and the views' agreement earn their keep: without any mask the plane has 58,000 flying ppm."""
    scan, _ = scan_of(rendered, "tissue")
    lost = {name: sum(v.lost[name] for v in scan.verdicts) for name in scan.verdicts[0].lost}
    assert lost["not_local"] > 500
    assert lost["jump"] > 500
    assert lost["saturated"] > 100
