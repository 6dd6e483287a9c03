"""The specimen told from its substrate: sizes against exact solids, what it says where there is none to be told."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from fringescope import heights, pipeline, specimen, store
from fringescope.settings import SpecimenSettings
from fringescope.twin import cuts, presets, scene
from fringescope.twin.shapes import Sphere
from fringescope.types import Cloud, Grid, Pose
from tests import cut_scenes as cs

UP = np.array([0.0, 0.0, 1.0])
INST = presets.instrument("paper", 0.06)
TISSUES = ("tissue-domed", "tissue-folded", "tissue-thin")


def found(cloud: Cloud, up=UP) -> specimen.Found:
    return specimen.find(cloud.xyz, cloud.normals, cloud.sigma, up)


@pytest.fixture(scope="module")
def clouds() -> dict[str, Cloud]:
    return {n: cs.traced(scene.make(n, 5), INST, np.random.default_rng(1)) for n in TISSUES}


@pytest.mark.parametrize("name", TISSUES)
def test_sizes_of_tissue(name: str, clouds: dict[str, Cloud]) -> None:
    f = found(clouds[name])
    volume, footprint, height = cuts.solid(scene.make(name, 5))
    p = f.pieces[0]
    assert len(f.pieces) == 1
    assert p.volume_mm3 == pytest.approx(volume, rel=0.01)
    assert abs(p.volume_mm3 - volume) < 3.5 * p.volume_sigma_mm3
    assert p.volume_sigma_mm3 < 0.01 * volume
    assert p.footprint_mm2 == pytest.approx(footprint, rel=0.03)
    assert abs(p.footprint_mm2 - footprint) < 3 * p.footprint_sigma_mm2
    assert abs(p.height_mm - height) < 0.02 + 3 * p.height_sigma_mm
    assert p.cut_off == 0
    assert f.substrate is not None
    assert f.substrate.frame.axes[2] == pytest.approx(UP, abs=1e-4)
    assert f.substrate.frame.origin[2] == pytest.approx(scene.SUBSTRATE_Z, abs=0.002)


def test_steps_are_boxes() -> None:
    view = scene.make("steps", 2)
    p = found(cs.traced(view, INST, np.random.default_rng(2))).pieces[0]
    boxes = [(np.array(b["high"]) - b["low"]) for b in view.truth["steps.json"]["steps"]]
    volume = sum(float(b.prod()) for b in boxes)
    assert p.volume_mm3 == pytest.approx(volume, rel=0.02)
    assert abs(p.volume_mm3 - volume) < 3 * p.volume_sigma_mm3
    assert p.length_mm == pytest.approx(72.0, abs=3 * p.length_sigma_mm + 0.1)
    assert p.width_mm == pytest.approx(36.0, abs=3 * p.width_sigma_mm + 0.1)
    assert p.height_mm == pytest.approx(10.0, abs=0.02)


def test_caps_of_spheres_are_pieces_the_largest_first() -> None:
    base, caps = -5.0, ((-18.0, 0.0, 14.0, 5.0), (22.0, 6.0, 9.0, 3.0))  # x, y, radius, height of the cap
    floor = scene.tilted_plane(np.eye(3), (0.0, 0.0, base), scene.STEEL)
    balls = [Sphere(scene.CERAMIC, (x, y, base + h - r), r) for x, y, r, h in caps]
    f = found(cs.traced(scene.Scene("caps", 0, (floor, *balls)), INST, np.random.default_rng(3)))
    assert len(f.pieces) == 2
    for p, (x, y, r, h) in zip(f.pieces, caps, strict=True):
        a = np.sqrt(h * (2 * r - h))
        assert p.volume_mm3 == pytest.approx(np.pi * h * h * (3 * r - h) / 3, rel=0.01)
        assert p.footprint_mm2 == pytest.approx(np.pi * a * a, rel=0.04)
        assert p.surface_mm2 == pytest.approx(2 * np.pi * r * h, rel=0.04)
        assert p.height_mm == pytest.approx(h, abs=0.03)
        assert p.length_mm == pytest.approx(2 * a, abs=4 * p.length_sigma_mm)
        assert p.middle == pytest.approx((x, y, base), abs=0.3)


def test_a_tilted_tray_in_another_world_gives_the_same_sizes(clouds: dict[str, Cloud]) -> None:
    c = clouds["tissue-domed"]
    R, t = cs.turn([0.25, -0.1, 0.6]), np.array([40.0, -300.0, 900.0])
    there = Cloud((c.xyz @ R.T + t).astype(np.float32), (c.normals @ R.T).astype(np.float32), c.rgb, c.sigma, c.view)
    a, b = found(c).pieces[0], found(there, R @ cs.turn([0.15, 0.1, 0]) @ UP).pieces[0]
    assert b.volume_mm3 == pytest.approx(a.volume_mm3, rel=2e-3)
    assert b.height_mm == pytest.approx(a.height_mm, abs=0.01)
    assert b.footprint_mm2 == pytest.approx(a.footprint_mm2, rel=0.01)


def test_a_wet_tray_of_which_little_is_seen_and_holes_in_the_specimen(clouds: dict[str, Cloud]) -> None:
    c, rng = clouds["tissue-domed"], np.random.default_rng(4)
    on = specimen.on_specimen(found(c), c.xyz)
    x, y = c.xyz[:, 0], c.xyz[:, 1]
    gone = ~on & (np.sin(x / 7) + np.sin(y / 5) > -1.1)  # highlights on most of the tray
    gone |= on & (np.hypot(x - 8, y - 3) < 4)  # and one on the specimen
    few = Cloud(*(a[~gone] for a in (c.xyz, c.normals, c.rgb, c.sigma, c.view)))
    below = few.xyz[:200] * [1, 1, 0] + [0, 0, -7.5] + rng.normal(0, 0.3, (200, 3))  # mirrored: under the tray
    few.xyz[:200] = below
    p = found(few).pieces[0]
    volume, _, _ = cuts.solid(scene.make("tissue-domed", 5))
    assert 0.01 < p.filled < 0.1
    assert p.volume_mm3 == pytest.approx(volume, rel=0.01)
    assert abs(p.volume_mm3 - volume) < 3 * p.volume_sigma_mm3


def test_what_runs_out_of_the_field_is_said_to(clouds: dict[str, Cloud]) -> None:
    c = clouds["tissue-domed"]
    keep = c.xyz[:, 0] < 10
    p = found(Cloud(*(a[keep] for a in (c.xyz, c.normals, c.rgb, c.sigma, c.view)))).pieces[0]
    assert p.cut_off > 0.05
    assert "runs out of the measured field" in specimen.words(specimen.figures(found(
        Cloud(*(a[keep] for a in (c.xyz, c.normals, c.rgb, c.sigma, c.view))))))  # fmt: skip


@pytest.mark.parametrize(
    ("cloud", "why"),
    [
        ("plane", "nothing lies on the substrate"),
        ("ball", "no substrate is to be seen"),
        ("filled", "no substrate is to be seen"),
        ("empty", "only 0 points"),
        ("nan", "only 0 points"),
        ("line", "points lie on a line"),
    ],
)
def test_where_there_is_none_it_says_so(cloud: str, why: str, clouds: dict[str, Cloud]) -> None:
    rng = np.random.default_rng(6)
    n = 20_000
    normals = np.tile([0, 0, 1.0], (n, 1))
    p = rng.uniform(-40, 40, (n, 3)) * [1, 0.6, 0]
    if cloud == "plane":
        p[:, 2] = 0.1 * p[:, 0] + rng.normal(0, 0.005, n)
    elif cloud == "ball":
        d = rng.standard_normal((n, 3))
        d[:, 2] = np.abs(d[:, 2]) + 0.3
        normals = d / np.linalg.norm(d, axis=1, keepdims=True)
        p = 20 * normals
    elif cloud == "filled":
        c = clouds["tissue-folded"]
        inner = (np.abs(c.xyz[:, 0]) < 25) & (np.abs(c.xyz[:, 1]) < 14)
        p, normals = c.xyz[inner].astype(float), c.normals[inner].astype(float)
    elif cloud == "empty":
        p, normals = p[:0], normals[:0]
    elif cloud == "nan":
        p[:] = np.nan
    elif cloud == "line":
        p[:, 1:] = 0
    f = specimen.find(p, normals, np.full(len(p), 0.005), UP)
    assert not f.pieces
    assert why in f.why
    assert not specimen.on_specimen(f, p).any()
    said = specimen.figures(f)
    assert said["found"] is False
    assert said["why"] in specimen.words(said)


def test_labels_are_the_pixels_that_hit_the_specimen() -> None:
    view = scene.make("tissue-thin", 7)
    f = found(cs.traced(view, INST, np.random.default_rng(8)))
    from fringescope.twin import optics, shapes

    cam = INST.rig.cameras[1]
    v, u = np.mgrid[: cam.lens.height, : cam.lens.width].astype(float)
    hits = shapes.trace(view.shapes, *optics.look(cam.lens, cam.pose, np.stack([u.ravel(), v.ravel()], 1)))
    shape = (cam.lens.height, cam.lens.width)
    sigma = np.full(shape, 0.005, np.float32)
    reasons = np.where(hits.shape.reshape(shape) < 0, 1, 0).astype(np.uint16)
    reasons[:40, :40] = 4
    grid = Grid(1, cam.name, hits.point.reshape(*shape, 3).astype(np.float32), sigma, reasons)
    got, true = specimen.labels(f, grid), hits.shape.reshape(shape) == 1
    assert not got[:40, :40].any()
    ok = grid.valid
    assert (got & ~true & ok).sum() == 0
    assert (true & ~got & ok).sum() < 0.02 * true.sum()  # the last 0.06 mm at its foot


def test_filling_follows_a_slope_and_never_rises_above_the_rim() -> None:
    y, x = np.mgrid[:60, :80].astype(float)
    truth = 0.1 * x + 0.05 * y
    hole = np.hypot(x - 40, y - 30) < 6
    full = heights.filled(np.where(hole, np.nan, truth), 60)
    assert np.abs(full - truth)[hole].max() < 0.12
    low, doubt = heights.bridged(np.where(hole, np.nan, truth))
    assert (low[hole] <= full[hole] + 0.05).all()
    assert (doubt[~hole] == 0).all()
    assert (np.abs(low - truth) < 4 * doubt)[hole].all()


def test_it_takes_little_of_a_scan() -> None:
    rng = np.random.default_rng(9)
    n = 230_000
    p = rng.uniform(-1, 1, (n, 3)) * [50, 32, 0]
    h = 12 * np.clip(1 - (p[:, 0] / 38) ** 2 - (p[:, 1] / 24) ** 2, 0, None)
    p[:, 2] = h + rng.normal(0, 0.005, n)
    normals = np.tile(np.float32([0, 0, 1]), (n, 1))
    sigma = np.full(n, 0.005, np.float32)
    p = p.astype(np.float32)
    took = []
    for _ in range(5):
        start = time.perf_counter()
        f = specimen.find(p, normals, sigma, UP)
        took.append(time.perf_counter() - start)
    assert f.pieces[0].volume_mm3 == pytest.approx(np.pi / 2 * 38 * 24 * 12, rel=0.005)
    assert min(took) < 0.4  # about 0.06 s on two idle cores


def test_every_scan_carries_it() -> None:
    view = scene.make("tissue-domed", 2)
    made = cs.photographed(view, presets.instrument("paper", 0.05), 3, rays=1, mirrors=False)
    said = made.figures["specimen"]
    volume, _, _ = cuts.solid(view)
    assert said["found"] is True
    assert said["pieces"][0]["volume_mm3"] == pytest.approx(volume, rel=0.02)
    assert store.plain(said)["pieces"][0]["middle"]
    assert "volume" in specimen.words(said)


def test_rendered_tissue(shared: Path) -> None:
    root = shared / "data" / "rendered-small"
    rig = store.read_rig(root / "truth" / "rig.json")
    scan = pipeline.scan(store.view_inputs(store.read_capture(root / "tissue")), rig, surface=False)
    V = np.load(root / "truth" / "tissue_mesh.npz")["V"]
    n = round(len(V) ** 0.5)
    h = (V[:, 2] - V[:, 2].min()).reshape(n, n)
    cell = (V[1, 0] - V[0, 0]) * (V[n, 1] - V[0, 1])
    volume = cell * float((h[:-1, :-1] + h[:-1, 1:] + h[1:, :-1] + h[1:, 1:]).sum()) / 4
    p = scan.figures["specimen"]["pieces"][0]
    assert p["volume_mm3"] == pytest.approx(volume, rel=0.006)
    assert p["height_mm"] == pytest.approx(h.max(), abs=0.03)
    assert p["footprint_mm2"] == pytest.approx(cell * float((h > 0).sum()), rel=0.03)


@pytest.mark.verify
@pytest.mark.parametrize("name", TISSUES)
def test_sigma_of_sizes_over_seeds(name: str) -> None:
    z = []
    for seed in range(10):
        view = scene.make(name, 100 + seed)
        f = found(cs.traced(view, presets.instrument("paper", 0.1), np.random.default_rng(seed)))
        volume, footprint, _ = cuts.solid(view)
        p = f.pieces[0]
        z.append([(p.volume_mm3 - volume) / p.volume_sigma_mm3, (p.footprint_mm2 - footprint) / p.footprint_sigma_mm2])
        assert abs(p.volume_mm3 / volume - 1) < 0.01
    spread = np.sqrt(np.mean(np.square(z), axis=0))
    print(f"{name}: error over sigma of volume and footprint {spread.round(2)}")
    assert (spread < 2.5).all()


def test_settings_move_the_thresholds() -> None:
    rng = np.random.default_rng(10)
    p = rng.uniform(-1, 1, (30_000, 3)) * [40, 25, 0]
    p[:, 2] = 0.2 * (np.hypot(p[:, 0], p[:, 1]) < 8) + rng.normal(0, 0.004, len(p))
    normals, sigma = np.tile([0.0, 0, 1], (len(p), 1)), np.full(len(p), 0.004)
    assert not specimen.find(p, normals, sigma, UP).pieces
    f = specimen.find(p, normals, sigma, UP, SpecimenSettings(high_mm=0.1))
    assert f.pieces[0].volume_mm3 == pytest.approx(0.2 * np.pi * 64, rel=0.03)
    assert isinstance(Pose(f.substrate.frame.axes, np.zeros(3)), Pose)
