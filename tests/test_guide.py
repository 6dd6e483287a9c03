"""Strokes to the tissue and to the projector: analytic surfaces tell where they lie, how long and how wide they are."""

from __future__ import annotations

import numpy as np
import pytest

from fringescope import geometry, guide
from fringescope.errors import EmptyResultError, GuidanceError
from fringescope.guide import drape, draw, fills, relief
from fringescope.kernels import guiding as k
from fringescope.settings import Settings, from_dict
from fringescope.types import Fill, Guidelines, Hidden, Layout, Side, Stroke, StrokeKind
from tests import fuse_scenes, guide_scenes
from tests.guide_scenes import S, diamond, land, one, seen_by, tissue, to_line
from tests.reference import guiding as slow

PLANE = fuse_scenes.plane()
BALL = fuse_scenes.ball()


@pytest.fixture(scope="module")
def on_plane() -> guide.Tissue:
    return tissue(PLANE, rng=np.random.default_rng(1))


@pytest.fixture(scope="module")
def on_ball() -> guide.Tissue:
    return tissue(BALL, rng=np.random.default_rng(2))


def wave(n: int = 60) -> np.ndarray:
    t = np.linspace(0, 1, n)
    return np.stack([30 + 90 * t, 60 + 15 * np.sin(5 * t)], 1)


# ------------------------------------------------------------------------------------------------------------ kernels


def test_relief_is_the_slow_one(rng: np.random.Generator) -> None:
    screen = np.column_stack([rng.uniform(-3, 20, 30), rng.uniform(-3, 16, 30), rng.uniform(200, 300, 30)])
    screen[3, 2], screen[5, 0] = -1, np.nan
    faces = rng.integers(0, 30, (25, 3))
    depth = np.full((13, 17), np.inf)
    k.relief(screen, faces, depth)
    assert depth == pytest.approx(slow.relief(screen, faces, depth.shape), rel=1e-9)


def test_drape_is_the_slow_one(rng: np.random.Generator) -> None:
    r = fuse_scenes.rig()
    g = fuse_scenes.grid(r, 0, BALL, 0.004, rng)
    pixels = rng.uniform(-2, [162, 122], (200, 2))
    o, rays = geometry.world_rays(r.cameras[0], pixels)
    out, sigma = np.empty((200, 3)), np.empty(200)
    k.drape(g.xyz, g.reasons, g.sigma, pixels, o, rays, 2, 3.0, 0, out, sigma)
    want = [
        slow.drape(g.xyz.astype(float), g.reasons, g.sigma, p, o, d, 2, 3.0) for p, d in zip(pixels, rays, strict=True)
    ]
    assert out == pytest.approx(np.array(want), abs=2e-4, nan_ok=True)
    assert np.isfinite(out[:, 0]).sum() > 100


@pytest.mark.parametrize("mirrors", [False, True])
def test_ribbons_cover_what_points_say(mirrors: bool) -> None:
    parts = np.array([[4.2, 5.1, 1.3, 14, 9.7, 2.2], [14, 9.7, 2.2, 20, 3, 0.4], [9, 12, 0.3, 9, 15, 0.3]])
    out = np.zeros((18, 12 if mirrors else 24), np.float32)
    k.ribbons(parts, mirrors, 0, out)
    for r in range(18):
        for c in range(out.shape[1]):
            u = 2 * c + r % 2 if mirrors else c
            assert out[r, c] == pytest.approx(slow.ribbon_share(parts, u, r, mirrors), abs=0.2), (c, r)
    whole = sum(slow.ribbon_share(parts, 2 * c + r % 2 if mirrors else c, r, mirrors) for r in range(18)
                for c in range(out.shape[1]))  # fmt: skip
    assert out.sum() == pytest.approx(whole, rel=0.04)


def test_paint_is_a_weighted_mean(rng: np.random.Generator) -> None:
    share = np.where(rng.random((9, 11)) < 0.3, 0, rng.random((9, 11))).astype(np.float32)
    color, under = np.float32([0.2, 1.0, 0.5]), rng.random((9, 11, 3)).astype(np.float32)
    out = under.copy()
    k.paint(share, color, out)
    assert out == pytest.approx(under * (1 - share[..., None]) + share[..., None] * color, abs=1e-6)


# ----------------------------------------------------------------------------------------------------- where it lies


@pytest.mark.parametrize("make", [lambda r: r, diamond])
@pytest.mark.parametrize("hit", [PLANE, BALL])
def test_a_stroke_in_a_photograph_lands_where_it_was_drawn(make, hit) -> None:
    r = make(fuse_scenes.rig())
    t = tissue(hit, r, rng=np.random.default_rng(3))
    g, image = one(Stroke("a", camera="camera2", pixels=wave(), width_mm=0.6), t)
    assert g.refused is None
    asked = seen_by(hit, r.cameras[1], drape.resampled(wave(), 0.2, 10_000)[0])
    where = land(hit, r.projector, np.concatenate(g.segments))
    off = 1e3 * to_line(where, asked)
    assert np.median(off) < 10
    assert np.percentile(off, 95) < 60
    assert image.shape == (r.projector.height, r.projector.width, 3)
    assert g.expected_error_um == pytest.approx(np.sqrt((off**2).mean()), abs=25)


def test_a_stroke_in_mm_is_projected_as_it_is(on_ball: guide.Tissue) -> None:
    a = np.linspace(0, 2 * np.pi, 200)
    rim = np.stack([4 * np.cos(a), 4 * np.sin(a), 4 + np.sqrt(36 - 16) + 0 * a], 1)
    g, _ = one(Stroke("a", world_mm=rim), on_ball)
    assert g.visible == 1
    assert len(g.segments) == 1
    want = geometry.project(on_ball.rig.projector, rim)
    assert to_line(want, g.segments[0]).max() < 0.02


def test_between_sparse_points_a_line_follows_the_surface(on_ball: guide.Tissue) -> None:
    ends = np.array([[-4.0, 0, 4 + np.sqrt(20)], [4.0, 0, 4 + np.sqrt(20)]])
    g, _ = one(Stroke("a", world_mm=ends), on_ball)
    assert g.visible == 1
    up = np.linalg.norm(np.concatenate(g.lands) - [0, 0, 4], axis=1)
    assert up == pytest.approx(6, abs=0.05)
    assert g.length_mm == pytest.approx(12 * np.arcsin(4 / 6), rel=0.01)


def test_length_has_an_honest_sigma() -> None:
    ends = np.array([[40.0, 40], [110, 70]])
    errors, sigmas = [], []
    for seed in range(12):
        t = tissue(PLANE, rng=np.random.default_rng(seed), sigma=0.02)
        truth = np.linalg.norm(np.diff(seen_by(PLANE, t.rig.cameras[0], ends), axis=0))
        g, _ = one(Stroke("a", camera="camera1", pixels=ends), t)
        errors.append(g.length_mm - truth)
        sigmas.append(g.length_sigma_mm)
    assert np.sqrt(np.mean(np.square(errors))) < 3 * np.mean(sigmas)
    assert np.abs(errors).max() < 0.06


def test_what_a_view_lost_is_carried_by_the_others_and_said() -> None:
    lost = tissue(PLANE, keep=lambda p, *_: np.hypot(p[..., 0], p[..., 1]) >= 2)
    r = lost.rig
    full = tissue(PLANE, r)
    mixed = guide.Tissue(r, (lost.grids[0], *full.grids[1:]), full.relief, full.spans, full.footprints, full.sigmas)
    middle = geometry.project(r.cameras[0], [0, 0, 1.0])
    line = middle + np.array([[-30.0, 0], [30, 0]])
    g, _ = one(Stroke("a", camera="camera1", pixels=line), mixed)
    assert g.visible == pytest.approx(1, abs=0.02)
    assert any("carried by the surface of other views" in n for n in g.notes)
    off = to_line(land(PLANE, r.projector, np.concatenate(g.segments)), seen_by(PLANE, r.cameras[0], line))
    assert off.max() < 0.03
    g, _ = one(Stroke("a", camera="camera1", pixels=line), lost)  # nobody measured it
    assert [h.why for h in g.hidden] == [Hidden.HOLE]
    assert sum(h.length_mm for h in g.hidden) == pytest.approx(4, abs=0.9)
    assert len(g.segments) == 2


def test_a_line_is_broken_where_the_surface_jumps() -> None:
    t = tissue(fuse_scenes.step(3.0))
    g, _ = one(Stroke("a", camera="camera1", pixels=[[30, 60], [130, 60]]), t)
    for piece in g.lands:
        assert np.ptp(piece[:, 2]) < 2.9 or np.abs(np.diff(piece[:, 2])).max() < 0.9
    if len(g.segments) == 1:
        pytest.fail("a step of 3 mm was drawn across")


# ------------------------------------------------------------------------------------------------------------- hidden


def hidden_and_lit(hit, t: guide.Tissue, strokes, clear: float):
    """Hidden points, those found; lit points, those taken for hidden; all `clear` units from a shadow's edge."""
    p = t.rig.projector
    light = geometry.centre(p.pose)

    def lit(q):
        ray = q - light
        far = np.linalg.norm(ray, axis=1)
        return hit(light, ray / far[:, None]) > far - 1e-2

    counts = np.zeros(4, int)
    for xyz in strokes:
        g, _ = one(Stroke("a", world_mm=xyz, width_mm=0.4), t)
        where = np.concatenate([np.zeros((0, 3)), *g.lands])
        shown = (np.linalg.norm(xyz[:, None] - where, axis=2).min(1) < 0.03) if len(where) else np.zeros(len(xyz), bool)
        uv = geometry.project(p, xyz)
        truth, use = lit(xyz), np.ones(len(xyz), bool)
        depth = geometry.transform(p.pose, land(hit, p, uv))[:, 2]
        for du, dv in ((clear, 0), (-clear, 0), (0, clear), (0, -clear)):
            use &= np.abs(geometry.transform(p.pose, land(hit, p, uv + np.array([du, dv])))[:, 2] - depth) < 0.8
        counts += [(a & use).sum() for a in (~truth, ~truth & ~shown, truth, truth & ~shown)]
    return counts


def test_hidden_parts_are_found() -> None:
    """At least 99 % of what the ball hides, at most 1 % false alarms, more than a mirror from its rim."""
    t = tissue(BALL, rng=np.random.default_rng(5))
    c, strokes = np.array([0, 0, 4.0]), []
    for z in np.linspace(-5.0, 5.6, 24):
        rho = np.sqrt(36 - z * z)
        a = np.linspace(0, 2 * np.pi, int(2 * np.pi * rho / 0.08))
        strokes.append(c + np.stack([rho * np.cos(a), rho * np.sin(a), z + 0 * a], 1))
    for rho in (1.0, 3.0, 5.0, 7.5, 10.0, 12.0):
        a = np.linspace(0, 2 * np.pi, int(2 * np.pi * rho / 0.08))
        strokes.append(np.stack([rho * np.cos(a), rho * np.sin(a), -2 + 0 * a], 1))
    hidden, found, lit, alarms = hidden_and_lit(BALL, t, strokes, 1.5)
    assert hidden > 2000
    assert found >= 0.99 * hidden
    assert alarms <= 0.01 * lit


def test_beyond_the_field_and_above_the_surface(on_plane: guide.Tissue) -> None:
    g, _ = one(Stroke("a", world_mm=[[0, 0, 1.0], [60, 0, -2.0]]), on_plane)
    assert Hidden.OUTSIDE in {h.why for h in g.hidden}
    g, _ = one(Stroke("a", world_mm=[[0, 0, 5.0], [5, 0, 5.0]]), on_plane)
    assert "float above the surface" in str(g.refused)
    assert not g.segments


# -------------------------------------------------------------------------------------------------------------- width


@pytest.mark.parametrize("make", [lambda r: r, diamond])
@pytest.mark.parametrize("tilt", [0, 30, 45, 60])
@pytest.mark.parametrize("turn", [0, 40, 90])
def test_width_on_the_tissue(make, tilt: int, turn: int) -> None:
    """Within 15 % of the asked width, or one mirror: the lit mirrors are cast onto the plane, and what they light is
    measured across the line.
    """
    r = make(fuse_scenes.rig())
    n = np.array([np.sin(np.radians(tilt)), 0, np.cos(np.radians(tilt))])
    hit = fuse_scenes.plane(n, 0.0)
    p = r.projector
    w, h = p.plane_size
    v, u = np.mgrid[:h, :w].astype(float)
    depth = geometry.transform(p.pose, land(hit, p, np.stack([u.ravel(), v.ravel()], 1)))[:, 2].reshape(h, w)
    made = relief.of_depth(depth.astype(np.float32), p, S.guide)
    t = guide.Tissue(r, (), made, (), (), ())
    e1, e2 = np.array([n[2], 0, -n[0]]), np.array([0, 1.0, 0])
    a = np.radians(turn)
    along = np.cos(a) * e1 + np.sin(a) * e2
    across = np.cross(n, along)
    s = np.linspace(-6, 6, 100)[:, None]
    width = 1.6
    g, image = one(Stroke("a", world_mm=s * along, width_mm=width, color=(255, 255, 255)), t)
    assert g.refused is None
    du, dv = geometry.lattice(p.width, p.height, p.layout)
    lit = image[..., 0] / 255.0
    spot = land(hit, p, np.stack([du[lit > 0], dv[lit > 0]], 1))
    near = np.abs(spot @ along) < 4
    x, weight = (spot @ across)[near], lit[lit > 0][near]
    # a line of width W, each mirror with its share of light: the mean square distance is W^2 / 12
    measured = np.sqrt(12 * np.average((x - np.average(x, weights=weight)) ** 2, weights=weight))
    beside = np.array([[w / 2, h / 2], [w / 2 + guide.mirror_units(p), h / 2]])
    mirror = float(np.linalg.norm(np.diff(land(hit, p, beside), axis=0)))
    assert measured == pytest.approx(width, abs=max(0.15 * width, mirror))
    assert np.average(x, weights=weight) == pytest.approx(0, abs=0.02)


def test_width_in_mirrors(on_plane: guide.Tissue) -> None:
    _, image = one(Stroke("a", world_mm=[[-8, 0, 1.4], [8, 0, 0.6]], width_px=3, color=(255, 255, 255)), on_plane)
    columns = image[:, 60:140, 0].sum(0) / 255
    assert np.median(columns) == pytest.approx(3, abs=0.35)


# ------------------------------------------------------------------------------------------------------------- shapes


def test_circle_is_as_far_everywhere_along_the_surface(on_ball: guide.Tissue) -> None:
    g, _ = one(Stroke("a", StrokeKind.CIRCLE, world_mm=[[0, 0, 10.0]], radius_mm=3.0), on_ball)
    rim = np.concatenate(g.lands)
    angle = np.arccos((rim - [0, 0, 4.0])[:, 2] / np.linalg.norm(rim - [0, 0, 4.0], axis=1))
    assert 6 * angle == pytest.approx(3.0, abs=0.06)
    assert g.length_mm == pytest.approx(2 * np.pi * 6 * np.sin(0.5), rel=0.02)
    assert g.area_mm2 == pytest.approx(2 * np.pi * 36 * (1 - np.cos(0.5)), rel=0.02)


def test_offsets_keep_their_distance(on_ball: guide.Tissue, on_plane: guide.Tissue) -> None:
    line = np.array([[-6.0, 0.0], [6.0, 0]])
    z = 1.0
    world = np.column_stack([line, (z * np.linalg.norm([0.05, 0.1, 1]) - line @ [0.05, 0.1])])
    g, _ = one(
        Stroke("a", StrokeKind.OFFSETS, world_mm=world, spacing_mm=2.0, count=3, side=Side.BOTH, width_mm=0.3), on_plane
    )
    assert len(g.traces) == 7
    for i, t in enumerate(g.traces[1:]):
        assert to_line(t.xyz, world) == pytest.approx(2.0 * (i // 2 + 1), abs=0.05)
    right = g.traces[1].xyz[:, :2].mean(0)
    eye = geometry.centre(on_plane.rig.projector.pose)[2]
    assert eye > 0
    assert np.cross([*(line[1] - line[0]), 0.0], [*right, 0.0])[2] < 0  # seen from above, to the right of +x is -y
    # on the ball: a meridian, and the line beside it, 2 mm along the surface
    a = np.linspace(-0.6, 0.6, 50)
    arc = np.stack([6 * np.sin(a), 0 * a, 4 + 6 * np.cos(a)], 1)
    g, _ = one(Stroke("a", StrokeKind.OFFSETS, world_mm=arc, spacing_mm=2.0, count=1), on_ball)
    away = 6 * np.arcsin(np.abs(g.traces[1].xyz[:, 1]) / 6)
    assert np.median(away) == pytest.approx(2.0, abs=0.05)


def test_offsets_do_not_cross_themselves(on_plane: guide.Tissue) -> None:
    a = np.linspace(0, np.pi, 60)
    bend = np.stack([2 * np.cos(a), 2 * np.sin(a)], 1)  # radius 2: no room for 3 mm inside
    world = np.column_stack([bend, np.linalg.norm([0.05, 0.1, 1]) - bend @ [0.05, 0.1]])
    g, _ = one(Stroke("a", StrokeKind.OFFSETS, world_mm=world, spacing_mm=3.0, side=Side.BOTH), on_plane)
    outer = [t for t in g.traces[1:] if len(t)]
    assert outer
    for t in outer:
        assert to_line(t.xyz, world).min() > 2.85


def test_arrow_has_its_head_at_the_end(on_plane: guide.Tissue) -> None:
    g, _ = one(Stroke("a", StrokeKind.ARROW, world_mm=[[-5, 0, 1.3], [5, 0, 0.8]], head_mm=2.0), on_plane)
    assert len(g.traces) == 3
    tip = np.array([5, 0, 0.8])
    for wing in g.traces[1:]:
        assert np.linalg.norm(wing.xyz[0] - tip) < 0.1
        assert wing.xyz[-1, 0] < 4
        assert np.linalg.norm(wing.xyz[-1] - wing.xyz[0]) == pytest.approx(2, abs=0.05)


@pytest.mark.parametrize("fill", [Fill.NONE, Fill.SOLID, Fill.HATCH])
def test_region(on_ball: guide.Tissue, fill: Fill) -> None:
    a = np.linspace(0, 2 * np.pi, 80)[:-1]
    cap = 4 + np.sqrt(36 - 9)
    ring = np.stack([3 * np.cos(a), 3 * np.sin(a), cap + 0 * a], 1)
    camera = on_ball.rig.cameras[0]
    for how in ({"world_mm": ring}, {"camera": "camera1", "pixels": geometry.project(camera, ring)}):
        g, image = one(Stroke("a", StrokeKind.REGION, fill=fill, spacing_mm=1.0, width_mm=0.3, **how), on_ball)
        assert g.area_mm2 == pytest.approx(2 * np.pi * 6 * (10 - cap), rel=0.03)
        assert g.area_sigma_mm2 is not None
        assert g.area_sigma_mm2 < 1
        lit = image.any(2)
        inner = geometry.project(on_ball.rig.projector, [0.0, 0.0, 10.0])
        c, r = np.round(inner).astype(int)
        share = lit[r - 8 : r + 9, c - 8 : c + 9].mean()
        assert {Fill.NONE: share == 0, Fill.SOLID: share == 1, Fill.HATCH: 0.1 < share < 0.9}[fill]
        outer = geometry.project(on_ball.rig.projector, [[4.2, 0.0, 4 + np.sqrt(36 - 4.2**2)]])[0]
        assert not lit[round(outer[1]), round(outer[0])]


def test_a_solid_region_lights_only_what_the_camera_meant() -> None:
    """Drawn over the ball and the floor behind it: the floor that the ball hides from the camera stays dark."""
    t = tissue(BALL, rng=np.random.default_rng(7))
    camera = t.rig.cameras[0]
    top = geometry.project(camera, [0.0, 0, 10.0])
    box = top + np.array([[-12, -12], [12, -12], [12, 12], [-12, 12.0]])
    _, image = one(Stroke("a", StrokeKind.REGION, camera="camera1", pixels=box, fill=Fill.SOLID, width_mm=0.1), t)
    v, u = np.nonzero(image.any(2))
    spot = land(BALL, t.rig.projector, np.stack([u, v], 1).astype(float))
    at = geometry.project(camera, spot)
    inside = (at > box.min(0) - 1.5).all(1) & (at < box.max(0) + 1.5).all(1)
    assert inside.mean() > 0.995
    o = geometry.centre(camera.pose)
    ray = spot - o
    far = np.linalg.norm(ray, axis=1)
    assert (BALL(o, ray / far[:, None]) > far - 0.6).mean() > 0.97  # but for a pixel at the ball's outline


def test_text_stands_where_it_was_put(on_plane: guide.Tissue) -> None:
    stroke = Stroke("a", StrokeKind.TEXT, world_mm=[[-8, 0, 1.4], [8, 0, 0.6]], text="HI 5 mm", size_mm=4.0)
    g, image = one(stroke, on_plane)
    v, u = np.nonzero(image.any(2))
    spot = land(PLANE, on_plane.rig.projector, np.stack([u, v], 1).astype(float))
    assert spot[:, 0].min() == pytest.approx(-8, abs=0.8)
    assert 2.2 < np.ptp(spot[:, 1]) < 4.5
    assert spot[:, 1].max() > 2  # up is away from the projector's down
    assert not g.hidden


def test_dashes_leave_gaps(on_plane: guide.Tissue) -> None:
    stroke = Stroke("a", world_mm=[[-8, 0, 1.4], [8, 0, 0.6]], width_mm=0.6)
    _, whole = one(stroke, on_plane)
    g, dashed = one(stroke, on_plane, dashed=True)
    assert 0.4 < dashed.any(2).sum() / whole.any(2).sum() < 0.75  # with their round ends
    assert g.length_mm == pytest.approx(16, rel=0.02)
    box = np.array([[-5, -4], [5, -4], [5, 4], [-5, 4.0]])
    solid = np.column_stack([box, np.linalg.norm([0.05, 0.1, 1]) - box @ [0.05, 0.1]])
    stroke = Stroke("a", StrokeKind.REGION, world_mm=solid, fill=Fill.SOLID, width_mm=0.2)
    whole, striped = one(stroke, on_plane)[1], one(stroke, on_plane, dashed=True)[1]
    assert 0.35 < striped.any(2).sum() / whole.any(2).sum() < 0.65


def test_colour_is_that_of_the_lamps_and_bounded(on_plane: guide.Tissue) -> None:
    stroke = Stroke("a", world_mm=[[-8, 0, 1.4], [8, 0, 0.6]], width_mm=3, color=(255, 128, 0))
    _, image = one(stroke, on_plane)
    assert tuple(image.reshape(-1, 3).max(0)) == (255, round(255 * ((128 / 255 + 0.055) / 1.055) ** 2.4), 0)
    _, image = one(stroke, on_plane, from_dict({"guide": {"brightness": 0.5}}, Settings()))
    assert image.max() == 128


# ---------------------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"pixels": [[1, 2], [3, 4]]}, "no camera"),
        ({"camera": "camera1"}, "neither of pixels and world_mm"),
        ({"camera": "camera1", "pixels": [[1, 2]], "world_mm": [[1, 2, 3]]}, "both"),
        ({"camera": "camera1", "pixels": [[1, 2]]}, "needs at least 2"),
        ({"camera": "camera1", "pixels": [[1, np.nan], [3, 4]]}, "1 of 2 points are NaN"),
        ({"camera": "camera1", "pixels": [[1, 2, 3], [3, 4, 5]]}, "shape"),
        ({"camera": "camera1", "pixels": [["a", 2], [3, 4]]}, "not numbers"),
        ({"camera": "camera1", "pixels": [[1, 2], [3, 4]], "width_mm": 900.0}, "width_mm is 900"),
        ({"camera": "camera1", "pixels": [[1, 2], [3, 4]], "width_mm": float("nan")}, "width_mm"),
        ({"camera": "camera1", "pixels": [[1, 2], [3, 4]], "width_mm": 1.0, "width_px": 2.0}, "both width_mm and"),
        ({"camera": "camera1", "pixels": [[1, 2], [3, 4]], "kind": StrokeKind.REGION}, "region needs at least 3"),
        ({"camera": "camera1", "pixels": [[1, 2]], "kind": StrokeKind.TEXT}, "without words"),
        ({"camera": "camera1", "pixels": [[1, 2], [3, 4]], "color": (300, 0, 0)}, "color"),
        ({"camera": "camera1", "pixels": [[1, 2], [3, 4]], "count": 0}, "count is 0"),
    ],
)
def test_strokes_that_mean_nothing_say_so(how: dict, words: str) -> None:
    with pytest.raises(GuidanceError, match=words):
        Stroke("a", **how)


def test_one_bad_stroke_does_not_harm_the_others(on_plane: guide.Tissue) -> None:
    good = Stroke("good", world_mm=[[-8, 0, 1.4], [8, 0, 0.6]])
    off = Stroke("off", camera="camera1", pixels=[[-500, 5], [-300, 40]])
    nobody = Stroke("nobody", camera="camera9", pixels=[[1, 2], [3, 4]])
    lost = Stroke("lost", StrokeKind.CIRCLE, world_mm=[[0, 0, 90.0]], radius_mm=2)
    made = guide.guide(Guidelines((off, good, nobody, lost)), on_plane, S.guide)
    alone, image = one(good, on_plane)
    assert (made.image == image).all()
    assert [g.refused is None for g in made.strokes] == [False, True, False, False]
    assert "the scan has camera1, camera2, camera3" in str(made.strokes[2].refused)
    assert alone.segments


def test_crossing_itself_many_points_and_no_length(on_plane: guide.Tissue) -> None:
    a = np.linspace(0, 20 * np.pi, 1_000_000)
    star = np.stack([80 + 30 * np.cos(3 * a), 60 + 30 * np.sin(2 * a)], 1)
    g, image = one(Stroke("many", camera="camera1", pixels=star), on_plane)
    assert g.visible > 0.95
    assert len(g.traces[0]) <= 2 * S.guide.max_samples
    assert image.any()
    g, _ = one(Stroke("knot", StrokeKind.REGION, camera="camera1", fill=Fill.SOLID,
                      pixels=[[60, 50], [100, 70], [100, 50], [60, 70]]), on_plane)  # fmt: skip
    assert g.area_mm2 == pytest.approx(0.5 * 40 * 20 * 0.0625 / np.cos(np.radians(30)), rel=0.25)  # by even and odd
    far = one(Stroke("far", camera="camera1", pixels=[[80, 60], [9e5, 60]]), on_plane)[0]
    near = one(Stroke("near", camera="camera1", pixels=[[80, 60], [400, 60]]), on_plane)[0]
    assert sum(len(x) for x in far.segments) == pytest.approx(sum(len(x) for x in near.segments), abs=2)
    assert to_line(np.concatenate(far.segments), np.concatenate(near.segments)).max() < 0.05
    noise = np.random.default_rng(0).uniform(0, 100, (100_000, 2))
    assert "split it" in str(one(Stroke("noise", camera="camera1", pixels=noise), on_plane)[0].refused)
    for text in ("日本", "a本"):
        stroke = Stroke("text", StrokeKind.TEXT, world_mm=[[-8, 0, 1.4]], text=text)
        assert "no letter" in str(one(stroke, on_plane)[0].refused)


def test_no_surface_no_guidance() -> None:
    r = fuse_scenes.rig()
    with pytest.raises(EmptyResultError, match="no surface"):
        guide.tissue([fuse_scenes.grid(r, 0, PLANE)], None, r, S.guide)


def test_nothing_is_shown_that_was_not_asked_for(on_plane: guide.Tissue) -> None:
    made = guide.guide(Guidelines(()), on_plane, S.guide)
    assert not made.image.any()
    g, image = one(Stroke("a", world_mm=[[-8, 0, 1.4], [8, 0, 0.6]], width_mm=0.6), on_plane)
    v, u = np.nonzero(image.any(2))
    away = to_line(np.stack([u, v], 1).astype(float), g.segments[0])
    assert away.max() < 0.3 * 5 + 1.2  # half the width in units, and the soft edge


def test_patches_of_the_diamond_lattice_keep_their_light() -> None:
    share = np.zeros((20, 30), np.float32)
    share[4:15, 6:21] = 1
    p = diamond(fuse_scenes.rig()).projector
    patch = fills.device_patch(share, (3, 5), p)
    assert patch.share.sum() == pytest.approx(share.sum() / 2, rel=0.03)  # a mirror is two units large
    assert (patch.top, patch.left) == (5, 1)
    assert p.layout is Layout.DIAMOND
    assert draw.linear((255, 255, 255)) == pytest.approx([1, 1, 1])
    assert guide_scenes.to_line(np.array([[0.0, 1]]), np.array([[-1.0, 0], [1, 0]])) == pytest.approx([1])
