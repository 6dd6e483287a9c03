"""Hidden parts of strokes, found by the scan alone, against ray casting through the twin's exact scene."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fringescope import geometry, guide
from fringescope.devices import simulated
from fringescope.pipeline import guidance
from fringescope.settings import Settings
from fringescope.twin import optics, shapes
from fringescope.types import Guidelines, Projector, Stroke
from tests.test_guide_loop import scanned

S = Settings()
PACE = 0.09  #: mm between the places of a stroke
CLEAR = 2.0  #: projector-plane units from a shadow's edge within which nobody is judged


def around_balls(scene: Any, rng: np.random.Generator) -> np.ndarray:
    """A circle on one of the balls, or on the base around and under one: places (n, 3)."""
    ball = scene.shapes[1 + int(rng.integers(2))]
    c, r = np.array(ball.center), float(ball.radius)
    a = np.linspace(0, 2 * np.pi, int(2 * np.pi * r / PACE))
    if rng.random() < 0.3:
        rho = rng.uniform(0.25, 1.6) * r  # not where ball and base touch
        return np.stack([c[0] + rho * np.cos(a), c[1] + rho * np.sin(a), np.full_like(a, c[2] - r)], 1)
    z = rng.uniform(-0.9, 0.95) * r
    rho = np.sqrt(r * r - z * z)
    return np.asarray(c + np.stack([rho * np.cos(a), rho * np.sin(a), np.full_like(a, z)], 1))


def straight_down(scene: Any, rng: np.random.Generator) -> np.ndarray:
    """A straight line seen from above, dropped onto whatever lies there: walls and the strips beside them."""
    p, q = rng.uniform([-36, -20], [36, 20], (2, 2))
    n = int(np.linalg.norm(q - p) / PACE) + 2
    xy = p + (q - p) * np.linspace(0, 1, n)[:, None]
    above, down = np.column_stack([xy, np.full(n, 60.0)]), np.tile([0, 0, -1.0], (n, 1))
    return np.asarray(shapes.trace(scene.shapes, above, down).point)


def wandering(scene: Any, rng: np.random.Generator) -> np.ndarray:
    """A line that wanders over the specimen, folds and clefts and all."""
    a = np.cumsum(rng.normal(0, 0.05, 300)) + rng.uniform(0, 7)
    xy = rng.uniform([-22, -12], [22, 12]) + np.cumsum(np.stack([np.cos(a), np.sin(a)], 1) * PACE, 0)
    h = shapes.trace(scene.shapes[-1:], np.column_stack([xy, np.full(300, 60.0)]), np.tile([0, 0, -1.0], (300, 1)))
    return np.asarray(h.point[(h.shape == 0) & (h.point[:, 2] > -5.5)])


DRAW = {"sphere": around_balls, "steps": straight_down}


def ground(scene: Any, p: Projector, uv: np.ndarray) -> np.ndarray:
    """Depth of what the projector's rays hit, mm."""
    o, d = optics.look(p.lens, p.pose, np.ascontiguousarray(uv))
    return np.asarray(shapes.trace(scene.shapes, o, d).t)


def counted(scene: Any, t: guide.Tissue, xyz: np.ndarray) -> np.ndarray:
    """Hidden places, those found; lit places, those taken for hidden."""
    p = t.rig.projector
    uv = geometry.project(p, xyz)
    w, h = p.plane_size
    use = ((uv > 3) & (uv < [w - 4, h - 4])).all(1)
    here = ground(scene, p, uv)
    for du, dv in ((CLEAR, 0), (-CLEAR, 0), (0, CLEAR), (0, -CLEAR)):
        use &= np.abs(ground(scene, p, uv + np.array([du, dv])) - here) < 1.0
    # a place is hidden where the ray that goes through it ends before
    hidden = np.linalg.norm(xyz - geometry.centre(p.pose), axis=1) > here + 0.02
    made = guide.guide(Guidelines((Stroke("a", world_mm=xyz, width_mm=0.6),)), t, S.guide).strokes[0]
    shown = np.zeros(len(xyz), bool)
    for piece in made.lands:
        shown |= np.linalg.norm(xyz[:, None] - piece, axis=2).min(1) < 0.02
    return np.array([(a & use).sum() for a in (hidden, hidden & ~shown, ~hidden, ~hidden & ~shown)])


FULL = pytest.mark.verify


@pytest.mark.parametrize(
    ("scene", "scale", "strokes"),
    [
        ("sphere", 0.06, 12),
        *(pytest.param(s, 0.125, 150, marks=FULL) for s in ("sphere", "steps")),
        *(pytest.param(s, 0.125, 150, marks=FULL) for s in ("tissue-domed", "tissue-folded", "tissue-thin")),
    ],
)
def test_hidden_parts_against_the_twin(scene: str, scale: float, strokes: int, record_property: Any) -> None:
    """At least 99 % of the hidden places are found, at most 1 % of the lit ones are taken for hidden."""
    with simulated.station(simulated.parse(f"sim://paper/{scene}?scale={scale}&seed=11")) as station:
        world, scan = station.world.scene, scanned(station, station.rig)
        t = guidance.tissue_of(scan.grids, scan.surface, station.rig, S)
    total = np.zeros(4, int)
    for seed in range(strokes):
        xyz = DRAW.get(scene, wandering)(world, np.random.default_rng([seed, 5]))
        if len(xyz) > 30:
            total += counted(world, t, xyz)
    hidden, found, lit, alarms = (int(x) for x in total)
    for name, value in (("hidden", hidden), ("found", found), ("lit", lit), ("false_alarms", alarms)):
        record_property(name, value)
    assert lit > 1000
    assert hidden > 100 or scene not in ("sphere", "steps")
    assert found >= 0.99 * hidden
    assert alarms <= (0.01 if scale > 0.1 else 0.02) * lit
