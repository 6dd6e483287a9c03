"""The simulated instrument, through the devices, to the surface: every preset and specimen, against exact truth."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from fringescope import capture, evaluate, patterns, pipeline
from fringescope.devices import simulated
from fringescope.settings import Settings
from fringescope.twin import presets, scene
from fringescope.types import Grid, NoiseModel, PatternPlan, Rig, Scan, ViewInput

S = Settings()


def world(name: str, preset: str, scale: float, seed: int) -> simulated.World:
    return simulated.World(scene.make(name, seed), presets.instrument(preset, scale), seed)


def record(w: simulated.World, plan: PatternPlan, light: bool = True) -> tuple[ViewInput, ...]:
    rig = w.instrument.rig
    with simulated.station(w) as s:
        images = [patterns.images(v, rig.projector, S.patterns) for v in plan.views]
        return capture.collect(s.projector, s.cameras, s.light if light else None, images, plan, S.capture)


def paper_plan(w: simulated.World) -> PatternPlan:
    rig = w.instrument.rig
    return patterns.paper_plan(rig, dict(zip([c.name for c in rig.cameras], w.instrument.pixel_formats, strict=True)))


@cache
def scan_of(name: str, preset: str, scale: float, seed: int) -> tuple[Scan, simulated.World]:
    w = world(name, preset, scale, seed)
    return pipeline.scan(record(w, paper_plan(w)), w.instrument.rig, S), w


def errors(scan: Scan, w: simulated.World) -> list[tuple[Grid, np.ndarray]]:
    """Per view: its grid and each point's signed distance from the true point along the ray, mm, NaN = none."""
    out = []
    for g in scan.grids:
        true = w.renderer.truth(g.camera).xyz
        ray = true - np.asarray(-w.instrument.rig.cameras[g.view].pose.R.T @ w.instrument.rig.cameras[g.view].pose.t)
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        out.append((g, ((g.xyz - true) * ray).sum(-1)))
    return out


@pytest.mark.parametrize("preset", ["paper", "single", "pair", "five"])
def test_every_preset_measures_a_plane(preset: str) -> None:
    scan, w = scan_of("plane", preset, 0.0625, 11)
    assert len(scan.grids) == len(w.instrument.rig.cameras)
    for g, e in errors(scan, w):
        ok = g.valid & np.isfinite(e)
        assert ok.mean() > 0.4, g.camera
        assert abs(np.median(e[ok])) < 0.5e-3, g.camera
        z = e[ok] / g.sigma[ok]
        assert 0.85 < 1.4826 * np.median(np.abs(z)) < 1.15, g.camera
        assert np.mean(np.abs(e[ok]) > 0.2) < 30e-6, g.camera
    assert scan.surface is not None
    assert scan.surface.n_faces > 1000
    assert len(scan.cloud) > 0.3 * scan.grids[0].reasons.size


@pytest.mark.parametrize(("name", "seed"), [("tissue-domed", 1), ("tissue-folded", 2), ("tissue-thin", 3)])
def test_every_specimen(name: str, seed: int) -> None:
    scan, w = scan_of(name, "paper", 0.0625, seed)
    every = [(e[g.valid & np.isfinite(e)], g) for g, e in errors(scan, w)]
    e = np.concatenate([x for x, _ in every])
    assert len(e) > 100_000
    assert 1.4826 * np.median(np.abs(e)) < 0.015
    assert np.mean(np.abs(e) > 0.2) < 2e-3
    for v, g in zip(scan.verdicts, scan.grids, strict=True):
        assert v.words[0].startswith(f"{g.camera}: {int(g.valid.sum())} points on ")


@pytest.mark.verify
@pytest.mark.parametrize("seed", range(20, 23))
@pytest.mark.parametrize("preset", ["paper", "single", "pair", "five"])
@pytest.mark.parametrize("name", ["sphere", "steps", "tissue-domed", "tissue-folded", "tissue-thin"])
def test_all_scenes_all_presets(name: str, preset: str, seed: int) -> None:
    scan, w = scan_of(name, preset, 0.0625, seed)
    e = np.concatenate([e[g.valid & np.isfinite(e)] for g, e in errors(scan, w)])
    assert 1.4826 * np.median(np.abs(e)) < 0.015
    assert np.mean(np.abs(e) > 0.2) < 3e-3


def repeated(scans: int) -> evaluate.Repeatability:
    w = world("plane", "pair", 0.0625, 5)
    rig = Rig(w.instrument.rig.projector, w.instrument.rig.cameras[:1], w.instrument.rig.volume)
    plan = paper_plan(w)
    one = PatternPlan(plan.projector_width, plan.projector_height, plan.layout, plan.views[:1])
    grids = []
    with simulated.station(w) as s:
        for _ in range(scans):
            images = [patterns.images(v, rig.projector, S.patterns) for v in one.views]
            view = capture.collect(s.projector, s.cameras[:1], None, images, one, S.capture)[0]
            grids.append(pipeline.scan_view(view, rig, S)[1])
    return evaluate.repeatability(grids)


def test_sigma_predicts_the_spread_of_repeated_scans() -> None:
    r = repeated(12)
    assert 0.9 <= r.ratio <= 1.1, r


@pytest.mark.verify
def test_sigma_predicts_the_spread_of_many_scans() -> None:
    assert 0.9 <= repeated(100).ratio <= 1.1


def test_tilted_fringes_beat_horizontal_ones_by_the_factor_that_geometry_predicts() -> None:
    w = world("plane", "paper", 0.0625, 7)
    rig = w.instrument.rig
    formats = dict(zip([c.name for c in rig.cameras], w.instrument.pixel_formats, strict=True))
    spread: dict[str, list[float]] = {c.name: [] for c in rig.cameras}
    predicted: dict[str, float] = {}
    for plan in (patterns.paper_plan(rig, formats), patterns.horizontal_plan(rig, formats)):
        for view in record(w, plan, light=False):
            name = view.plan.camera
            _, g = pipeline.scan_view(view, rig, S)
            true = w.renderer.truth(name).xyz
            d = np.linalg.norm(g.xyz - true, axis=-1)
            spread[name].append(float(np.median(d[g.valid & np.isfinite(d)])))
    for view_plan in patterns.paper_plan(rig, formats).views:
        p = patterns.predict(rig, view_plan, NoiseModel(0.2, 0.015), 60.0, 70.0)
        predicted[view_plan.camera] = float(p.gain_over_horizontal[0])
    assert max(predicted.values()) > 1.8  # the two oblique cameras
    for name, (tilted, horizontal) in spread.items():
        assert horizontal / tilted == pytest.approx(predicted[name], rel=0.1), name
