"""From the simulated instrument's light to points, for every preset: the whole chain against the twin's truth."""

from __future__ import annotations

import numpy as np
import pytest

from fringescope import capture, patterns, pipeline
from fringescope.devices import registry, simulated
from fringescope.settings import Settings
from fringescope.types import Layout, PixelFormat, ViewInput


def view_of(station: simulated.SimulatedStation, index: int) -> ViewInput:
    plan = patterns.paper_plan(station.rig, {c.name: c.settings.pixel_format for c in station.cameras})
    view = plan.views[index]
    images = patterns.images(view, station.rig.projector)
    return ViewInput(view, list(capture.stream(station.projector, station.cameras[index], images, view)))


@pytest.mark.parametrize(
    ("uri", "cameras", "fmt"),
    [
        ("sim://paper/plane?scale=0.05&seed=1", 3, PixelFormat.BAYER_RG8),
        ("sim://single/plane?scale=0.06&seed=2&lift=9", 1, PixelFormat.MONO12),
        ("sim://pair/sphere?scale=0.06&seed=3", 2, PixelFormat.BAYER_RG8),
        ("sim://five/steps?scale=0.06&seed=4", 5, PixelFormat.BAYER_RG8),
        ("sim://paper/tissue-domed?scale=0.06&seed=5", 3, PixelFormat.BAYER_RG8),
    ],
)
def test_points_lie_where_the_twin_says(uri: str, cameras: int, fmt: PixelFormat) -> None:
    station = registry.open_station(uri)
    assert isinstance(station, simulated.SimulatedStation)
    with station:
        assert len(station.cameras) == cameras
        assert all(c.settings.pixel_format is fmt for c in station.cameras)
        assert station.rig.projector.layout is Layout.DIAMOND
        index = cameras - 1
        _, grid = pipeline.scan_view(view_of(station, index), station.rig, Settings())
        truth = station.world.renderer.truth(station.rig.cameras[index].name)
    points = grid.valid
    error = np.linalg.norm(grid.xyz.astype(np.float64) - truth.xyz, axis=-1)[points]
    sigma = grid.sigma[points]
    assert points.sum() > 0.6 * truth.lit.sum()
    assert np.median(error) < 0.007  # mm
    assert (error > 0.2).mean() < 0.005
    if "plane" in uri:
        along = np.einsum("ij,ij->i", (grid.xyz - truth.xyz)[points], rays_of(station, index)[points])
        spread = 1.4826 * np.median(np.abs(along / sigma))
        assert 0.9 < spread < (1.1 if fmt.bits == 8 else 1.2)
        assert abs(np.median(along)) < 3e-4


def rays_of(station: simulated.SimulatedStation, index: int) -> np.ndarray:
    """Unit vectors (H, W, 3) from the camera to what each pixel sees, from the twin's own truth."""
    camera = station.rig.cameras[index]
    seen = station.world.renderer.truth(camera.name).xyz + camera.pose.R.T @ camera.pose.t
    return np.asarray(seen / np.linalg.norm(seen, axis=-1, keepdims=True))


def test_sigma_is_the_spread_of_repeated_scans() -> None:
    station = registry.open_station("sim://paper/plane?scale=0.03&seed=6")
    assert isinstance(station, simulated.SimulatedStation)
    with station:
        grids = [pipeline.scan_view(view_of(station, 0), station.rig, Settings())[1] for _ in range(6)]
        ray = rays_of(station, 0)
    everywhere = np.all([g.valid for g in grids], axis=0)
    along = np.array([np.einsum("ij,ij->i", g.xyz[everywhere], ray[everywhere]) for g in grids], np.float64)
    predicted = np.median([g.sigma[everywhere] for g in grids], axis=0)
    assert everywhere.sum() > 1500
    ratio = np.sqrt(np.mean(along.var(axis=0, ddof=1) / predicted**2))
    assert ratio == pytest.approx(1.0, abs=0.1)
