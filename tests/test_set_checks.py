"""What captures tell of themselves: noise at any quantisation, spoilt frames, sets that contradict each other."""

from dataclasses import replace

import numpy as np
import pytest

from fringescope import phase, pipeline
from fringescope.errors import EmptyResultError
from fringescope.settings import Settings
from fringescope.types import GraySet, PixelFormat, Rig, ViewInput, Volume
from tests import core_scenes as core
from tests import fuse_scenes as scenes

S = Settings()
PLANE = np.array([0.05, 0.1, 1.0]) / np.linalg.norm([0.05, 0.1, 1.0])


@pytest.fixture(scope="module")
def rig() -> Rig:
    r = scenes.rig(2, 200, 150)
    return Rig(r.projector, r.cameras, Volume(np.zeros(3), np.eye(3), np.array([24.0, 20, 6])))


def view_of(rig, periods=(270.0, 60.0, 16.0), steps=(4, 4, 4), rng=None, noise=(0.5, 0.02)):
    camera = rig.cameras[1]
    return core.view(rig, camera, core.plane_points(camera, PLANE, 1.0), periods, steps, noise, rng)[0]


def altered(view, number, change):
    """The frames with those of set `number` changed: `change(step, N, frames)` gives what stands at a step."""
    N = view.plan.sets[number].steps
    own = {k.number: f for k, f in view.frames if k.set_index == number}
    frames = [(k, change(k.number, N, own) if k.set_index == number else f) for k, f in view.frames]
    return replace(view, frames=frames)


@pytest.mark.parametrize("steps", [4, 5, 8])
@pytest.mark.parametrize("variance", [0.05, 0.2, 0.5, 1.0, 2.5, 6.0])
def test_noise_of_integer_codes(rng, variance, steps):
    """With four steps the residuals of integer codes take few values; the noise must not jump between them."""
    plan = core.plan(core.fringes(270, 0, steps), core.fringes(16, 0, steps), pixel_format=PixelFormat.MONO8)
    u, v = core.image(shape=(200, 300))
    A = 60 + 60 * u / 400
    frames = core.draw(plan, u, v, A, 40 + 0 * u, (variance, 0.0), rng)
    got = phase.measure(frames, plan, S.phase).noise
    assert got.source == "residuals"
    for level in (70, 90, 110):
        assert got.a + got.b * level == pytest.approx(variance + 1 / 12, rel=0.12)  # 6 % of sigma


def test_a_lost_frame_is_not_taken_for_noise(rig, rng):
    view = view_of(rig, rng=rng)
    black = altered(view, 2, lambda n, _N, own: own[n] * (n != 1))
    clean, spoilt = (phase.measure(v.frames, v.plan, S.phase).noise for v in (view, black))
    assert spoilt.variance(100) == pytest.approx(clean.variance(100), rel=0.2)
    with pytest.raises(EmptyResultError, match="inconsistent"):
        pipeline.scan([black], rig, S, surface=False)


@pytest.mark.parametrize(
    ("number", "change", "word"),
    [
        (2, lambda n, N, own: own[(n + 1) % N], "miss what those of 60 predict by"),
        (1, lambda n, N, own: own[(n + 1) % N], "miss what those of 270 predict by"),
        (0, lambda n, N, own: own[-n % N], "nothing to do with"),
        (1, lambda n, N, own: own[-n % N], "nothing to do with"),
        (0, lambda n, _N, own: own[n], None),
    ],
)
def test_sets_that_contradict_each_other_are_named(rig, rng, number, change, word):
    view = altered(view_of(rig, rng=rng), number, change)
    notes = pipeline.clean_view(view, rig, S).notes
    fused, _ = pipeline.scan_view(view, rig, S)
    assert fused.notes == notes
    if word is None:
        assert notes == ()
    else:
        assert any(word in note for note in notes)


def test_two_close_periods_of_pure_fringes_are_told_apart(rig, rng):
    """Their beat amplifies any error thirtyfold: what is needed is less than the systematic error usually assumed."""
    view = view_of(rig, (16.0, 15.5), (8, 8), rng, noise=(0.02, 0.0))
    decoded, grid = pipeline.scan_view(view, rig, S)
    assert grid.valid.mean() > 0.8
    assert np.abs(grid.xyz[grid.valid].astype(float) @ PLANE - 1.0).max() < 0.1
    assert decoded.notes == ()


@pytest.mark.parametrize("inverse", [True, False])
def test_gray_cells_as_wide_as_a_period_cost_no_stripes(rng, inverse):
    fine = core.fringes(20.0, 0, 6)
    code = GraySet("u", 20.0, 5, inverse)
    plan = core.plan(fine, code, pixel_format=PixelFormat.MONO8)
    u, v = core.image(shape=(200, 600))
    decoded = pipeline.decode_view(ViewInput(plan, core.draw(plan, u, v, noise=(0.5, 0.01), rng=rng)), S)
    ok = decoded.reasons == 0
    assert ok.mean() > (0.98 if inverse else 0.94)  # without inverse frames code 0 is dark in all of them
    got, _ = phase.projector_coordinates(decoded)
    assert np.abs(got[ok] - u[ok]).max() < 1.0


