"""Nothing is shown that was not asked for: fills on other tissue, torn letters, chords of circles, colours unseen."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fringescope import geometry, guide, store
from fringescope.settings import Settings, from_dict
from fringescope.types import Fill, Guidelines, Stroke, StrokeKind
from tests import fuse_scenes
from tests.guide_scenes import S, land, one, seen_by, tissue, to_line

PLANE = fuse_scenes.plane()
BALL = fuse_scenes.ball()
STEP = fuse_scenes.step(3.0)


@pytest.fixture(scope="module")
def on_plane() -> guide.Tissue:
    return tissue(PLANE, rng=np.random.default_rng(1))


@pytest.fixture(scope="module")
def on_ball() -> guide.Tissue:
    return tissue(BALL, rng=np.random.default_rng(2))


@pytest.fixture(scope="module")
def on_step() -> guide.Tissue:
    return tissue(STEP, rng=np.random.default_rng(3))


def square(half: float, depths: tuple[float, float, float, float]) -> np.ndarray:
    """Corners on the plane, each so much below it."""
    xy = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
    return np.column_stack([xy, np.linalg.norm([0.05, 0.1, 1]) - xy @ [0.05, 0.1] - np.array(depths)])


def lit(image: np.ndarray) -> np.ndarray:
    """Units of the plane that are lit (n, 2), of a projector on a grid."""
    v, u = np.nonzero(image.any(2))
    return np.stack([u, v], 1).astype(float)


# -------------------------------------------------------------------------------------------------------------- fills


@pytest.mark.parametrize("fill", [Fill.SOLID, Fill.HATCH])
def test_a_region_below_the_surface_lights_nothing(on_plane: guide.Tissue, on_ball: guide.Tissue, fill: Fill) -> None:
    how = {"kind": StrokeKind.REGION, "fill": fill, "spacing_mm": 1.0}
    g, image = one(Stroke("a", world_mm=square(5, (20, 20, 20, 20)), **how), on_plane)
    assert not image.any()
    assert not g.segments
    assert any("100% of what it encloses stays dark" in n for n in g.notes)
    a = np.linspace(0, 2 * np.pi, 60)[:-1]
    floor = np.stack([5 * np.cos(a), 5 * np.sin(a), -2 + 0 * a], 1)  # under the ball, which hides it
    assert not one(Stroke("a", world_mm=floor, **how), on_ball)[1].any()


@pytest.mark.parametrize("fill", [Fill.SOLID, Fill.HATCH])
def test_a_region_that_dives_below_the_surface_is_lit_where_it_is_on_it(on_plane: guide.Tissue, fill: Fill) -> None:
    ring = square(5, (0, 0, 20, 20))
    g, image = one(Stroke("a", StrokeKind.REGION, world_mm=ring, fill=fill, spacing_mm=1.0, width_mm=0.2), on_plane)
    assert g.segments
    spot = land(PLANE, on_plane.rig.projector, lit(image))
    assert to_line(spot, ring[:2]).max() < 1.2  # the side that lies on it
    assert sum(h.length_mm for h in g.hidden) > 30


def test_a_region_on_the_surface_is_filled_whole(on_plane: guide.Tissue, on_ball: guide.Tissue) -> None:
    _, image = one(Stroke("a", StrokeKind.REGION, world_mm=square(5, (0, 0, 0, 0)), fill=Fill.SOLID), on_plane)
    whole = lit(image)
    rows = [np.ptp(whole[whole[:, 1] == v, 0]) + 1 - (whole[:, 1] == v).sum() for v in np.unique(whole[:, 1])]
    assert max(rows) == 0
    a = np.linspace(0, 2 * np.pi, 80)[:-1]  # a ring on the ball: what it encloses bulges out by 2 mm
    ring = np.stack([4.4 * np.cos(a), 4.4 * np.sin(a), 4 + np.sqrt(36 - 4.4**2) + 0 * a], 1)
    g, _ = one(Stroke("a", StrokeKind.REGION, world_mm=ring, fill=Fill.SOLID), on_ball)
    assert g.area_mm2 == pytest.approx(2 * np.pi * 6 * (6 - np.sqrt(36 - 4.4**2)), rel=0.03)
    assert not g.notes


# --------------------------------------------------------------------------------------------------------------- text


def same_as_told(g, image: np.ndarray) -> None:
    """What a text lights is what its record says."""
    where = lit(image)
    away = np.min([to_line(where, ring) for ring in g.segments], axis=0)
    boxes = [(r.min(0) - 1, r.max(0) + 1) for r in g.segments]
    within = np.any([((where >= a) & (where <= b)).all(1) for a, b in boxes], axis=0)
    assert (within | (away < 1.5)).all()
    for h in g.hidden:
        middle = h.segment.mean(0)
        assert not image[round(middle[1]), round(middle[0])].any()


def test_letters_that_are_not_on_the_surface_are_not_drawn() -> None:
    t = tissue(PLANE, keep=lambda p, *_: np.abs(p[..., 0] - 2) >= 1.5)
    stroke = Stroke("a", StrokeKind.TEXT, world_mm=square(8, (0,) * 4)[[0, 1]] + [0, 8.0, -0.8], text="HIHIHI",
                    size_mm=5.0)  # fmt: skip
    g, image = one(stroke, t)
    assert 0.3 < g.visible < 0.95
    assert any("of 6 letters are not wholly on visible, unbroken surface" in n for n in g.notes)
    spot = land(PLANE, t.rig.projector, lit(image))
    assert (np.abs(spot[:, 0] - 2) > 1.4).all()
    same_as_told(g, image)
    g, image = one(Stroke("a", StrokeKind.TEXT, world_mm=stroke.points, text="HI", size_mm=50.0), t)
    assert "no letter of it lies wholly on visible surface" in str(g.refused)
    assert not image.any()


def test_no_letter_is_torn_by_a_step(on_step: guide.Tissue) -> None:
    told = []
    for start in ([60, 50], [64, 70], [50, 40]):
        pixels = [start, [start[0] + 30, start[1] + 3]]
        stroke = Stroke("a", StrokeKind.TEXT, camera="camera1", pixels=pixels, text="HEHEHEHE", size_mm=3)
        g, image = one(stroke, on_step)
        if g.refused is None:
            same_as_told(g, image)
            assert all(np.linalg.norm(np.diff(p, axis=0), axis=1).max() < 0.6 for p in g.lands)
            told += g.notes
    assert any("(torn by a jump)" in n for n in told)


@pytest.mark.parametrize("fill", list(Fill))
def test_an_outline_that_crosses_itself_is_told(fill: Fill, on_plane: guide.Tissue) -> None:
    a = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    round_ = np.stack([100 + 20 * np.cos(a), 60 + 15 * np.sin(a)], 1)
    for outline, crosses in (
        (round_, False),
        (np.vstack([round_, round_[:3] * 1.001]), False),  # the end runs over the start a little
        (np.vstack([round_, 100 + 0.9 * (round_ - 100)]), True),
        (np.array([[80, 50], [120, 70], [80, 70], [120, 50.0]]), True),
    ):
        stroke = Stroke("a", StrokeKind.REGION, camera="camera1", pixels=outline, fill=fill)
        world = seen_by(PLANE, on_plane.rig.cameras[0], outline)
        for x in (stroke, Stroke("a", StrokeKind.REGION, world_mm=world, fill=fill)):
            g, image = one(x, on_plane)
            assert g.refused is None, g.refused
            assert image.any()
            assert any("crosses itself" in n for n in g.notes) is crosses


def test_progress_counts_the_strokes(on_plane: guide.Tissue) -> None:
    seen: list[tuple[int, int]] = []
    strokes = tuple(Stroke(str(i), camera="camera1", pixels=[[80, 50], [90 + i, 60]]) for i in range(3))
    guide.guide(Guidelines(strokes), on_plane, S.guide, progress=lambda done, of: seen.append((done, of)))
    assert seen == [(0, 3), (1, 3), (2, 3), (3, 3)]


@pytest.mark.parametrize("hit", [BALL, STEP])
def test_text_runs_through_its_second_point(hit, on_ball: guide.Tissue, on_step: guide.Tissue) -> None:
    t = on_ball if hit is BALL else on_step
    camera = t.rig.cameras[0]
    top = geometry.project(camera, [-4.0, 1.0, 4 + np.sqrt(19)]) if hit is BALL else np.array([40.0, 60])
    start, end = top, top + np.array([14.0, 4.0])
    g, _ = one(Stroke("a", StrokeKind.TEXT, camera="camera1", pixels=[start, end], text="LLL", size_mm=2.0), t)
    assert len(g.segments) == 3
    along = (end - start) / np.linalg.norm(end - start)
    for letter in g.lands:
        foot = (geometry.project(camera, letter) - start) @ np.array([-along[1], along[0]])
        assert foot.max() == pytest.approx(0, abs=0.6)  # pixels below the line that was asked for
    world = t.relief.at(geometry.project(t.rig.projector, g.lands[0][:1]))
    far = world + np.array([[5.0, 0.5, 0]])
    far = t.relief.at(geometry.project(t.rig.projector, far))
    g, _ = one(Stroke("a", StrokeKind.TEXT, world_mm=np.concatenate([world, far]), text="LLLLL", size_mm=1.5), t)
    a, b = geometry.project(t.rig.projector, np.concatenate([world, far]))
    side = np.array([-(b - a)[1], (b - a)[0]]) / np.linalg.norm(b - a)
    assert all(((ring - a) @ side).max() == pytest.approx(0, abs=0.3) for ring in g.segments)


# ------------------------------------------------------------------------------------------------------------ circles


@pytest.mark.parametrize("fill", [Fill.NONE, Fill.SOLID])
def test_a_circle_is_broken_where_the_surface_jumps(on_step: guide.Tissue, on_ball: guide.Tissue, fill: Fill) -> None:
    for t, hit, at, radius in (
        (on_step, STEP, [-2.0, 0], 5.0), (on_step, STEP, [3.0, 1.0], 6.0), (on_ball, BALL, [0.0, 0], 11.0),
    ):  # fmt: skip
        centre = t.relief.at(geometry.project(t.rig.projector, [[*at, 10.0 if hit is BALL else 0.0]]))
        g, image = one(Stroke("a", StrokeKind.CIRCLE, world_mm=centre, radius_mm=radius, fill=fill, width_mm=0.2), t)
        if hit is BALL and fill is Fill.NONE:  # no part of it
            assert "none of it lies on the measured surface" in str(g.refused)
            continue
        assert any("not reached along the surface" in n or "is broken" in n for n in g.notes)
        assert g.length_mm < 1.1 * 2 * np.pi * radius
        for p in g.lands:
            assert np.linalg.norm(np.diff(p, axis=0), axis=1).max() < 0.9
        spot = land(hit, t.rig.projector, lit(image))
        away = np.linalg.norm(spot - centre, axis=1)
        assert (away < radius + 0.4).mean() > 0.98  # but for units at the edge
        if hit is STEP and fill is Fill.SOLID:  # nothing on the other side of the step
            same = np.abs(spot[:, 2] - centre[0, 2]) < 1.5
            assert same.mean() > 0.99


def test_a_solid_circle_is_whole_on_a_whole_surface(on_ball: guide.Tissue) -> None:
    stroke = Stroke("a", StrokeKind.CIRCLE, world_mm=[[0, 0, 10.0]], radius_mm=4.0, fill=Fill.SOLID, width_mm=0.2)
    g, image = one(stroke, on_ball)
    assert g.area_mm2 == pytest.approx(2 * np.pi * 36 * (1 - np.cos(4 / 6)), rel=0.02)
    spot = land(BALL, on_ball.rig.projector, lit(image))
    angle = np.arccos((spot - [0, 0, 4.0])[:, 2] / 6)
    assert (6 * angle).max() < 4.5
    whole = lit(image)
    assert all(np.ptp(whole[whole[:, 1] == v, 0]) + 1 == (whole[:, 1] == v).sum() for v in np.unique(whole[:, 1]))


def test_a_centre_below_the_surface_is_refused(on_plane: guide.Tissue) -> None:
    deep = square(5, (20, 20, 20, 20))
    for kind, more in ((StrokeKind.CIRCLE, {"radius_mm": 3.0}), (StrokeKind.TEXT, {"text": "cut"})):
        g, image = one(Stroke("a", kind, world_mm=deep[:2], **more), on_plane)
        assert g.refused is not None
        assert not image.any()


# ------------------------------------------------------------------------------------------- colours and odd numbers


def test_what_nobody_sees_is_refused(on_plane: guide.Tissue) -> None:
    line = [[-8, 0, 1.4], [8, 0, 0.6]]
    red = Stroke("red", world_mm=line)
    _, alone = one(red, on_plane)
    for color in ((0, 0, 0), (20, 20, 20)):
        made = guide.guide(Guidelines((red, Stroke("k", world_mm=line, color=color, width_mm=3))), on_plane, S.guide)
        assert "too dark to be seen" in str(made.strokes[1].refused)
        assert (made.image == alone).all()
    dim = from_dict({"guide": {"brightness": 0.01}}, Settings())
    assert "raise guide.brightness" in str(one(Stroke("k", world_mm=line, color=(0, 0, 60)), on_plane, dim)[0].refused)


def test_what_later_strokes_paint_over_is_said(on_plane: guide.Tissue) -> None:
    line = np.array([[-8, 0, 1.4], [8, 0, 0.6]])
    over = Stroke("over", world_mm=line[:1] + (line[1:] - line[:1]) * [[0.5], [1.0]], width_mm=1.5, color=(0, 255, 0))
    cross = Stroke("cross", world_mm=[[-4, -5, 1.7], [-4, 5, 0.7]], color=(0, 0, 255), width_mm=0.4)
    made = guide.guide(Guidelines((Stroke("red", world_mm=line), over)), on_plane, S.guide)
    told = [n for n in made.strokes[0].notes if "paint over" in n]
    assert len(told) == 1
    assert 45 <= int(told[0].rsplit(" ", 3)[1].rstrip("%")) <= 60
    assert not made.strokes[1].notes
    made = guide.guide(Guidelines((Stroke("red", world_mm=line), cross)), on_plane, S.guide)
    assert not made.strokes[0].notes  # a crossing is no loss


@pytest.mark.parametrize("digits", [400, 5000])
@pytest.mark.parametrize("key", ["width_mm", "width_px", "spacing_mm", "radius_mm", "head_mm", "size_mm", "count"])
def test_a_number_too_large_refuses_its_stroke_only(tmp_path: Path, digits: int, key: str) -> None:
    good = '{"id": "good", "world_mm": [[1, 2, 3], [4, 5, 6]]}'
    bad = f'{{"id": "bad", "world_mm": [[1, 2, 3], [4, 5, 6]], "{key}": {"9" * digits}}}'
    head = '{"format": "fringescope-guidelines", "version": 1, "strokes": ['
    (tmp_path / "g.json").write_text(f"{head}{bad}, {good}]}}")
    g = store.read_guidelines(tmp_path / "g.json")
    assert [s.id for s in g.strokes] == ["good"]
    assert key in g.refused["bad"]
    assert len(g.refused["bad"]) < 200
