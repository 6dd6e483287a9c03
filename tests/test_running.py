"""Frames of the finest set that are summed one by one as they come: by a slow twin, and all at once, bit for bit."""

import weakref
from dataclasses import replace

import numpy as np
import pytest

from fringescope import pipeline
from fringescope.errors import CaptureError
from fringescope.pipeline import arrival, fast
from fringescope.settings import Settings
from fringescope.types import NoiseModel, PixelFormat
from tests.test_fused import packed, rig_of, view_of

S = Settings()
FORMATS = [PixelFormat.MONO8, PixelFormat.MONO10, PixelFormat.BAYER_RG12, PixelFormat.MONO16, PixelFormat.BAYER_RG8]


def drawn(rig, fmt=PixelFormat.MONO8, steps=(4, 4, 8), **how):
    """A view with the noise that it was drawn with: then no statistics of what has come decide anything."""
    scale = fmt.max_value / 255
    view = view_of(rig, rig.cameras[1], fmt, steps=steps, **how)
    return replace(view, noise=NoiseModel(0.5 * scale**2, 0.02 * scale))


def summed(frames, view, rig, rooms=None):
    """What has begun when these frames have come; `rooms`: for each, whether there was time to sum it."""
    beginning = fast.Beginning(view, rig, S)
    for n, (key, frame) in enumerate(frames):
        beginning.add(key, frame, 1e9 if rooms is None or rooms[n] else 0.0)
    return replace(view, frames=beginning.frames), beginning.begun


def same(got, want):
    for a, b in (
        (got.xyz, want.xyz),
        (got.sigma_mm, want.sigma_mm),
        (got.steps, want.steps),
        (got.decoded.background, want.decoded.background),
        (got.decoded.modulation, want.decoded.modulation),
        (got.decoded.reasons, want.decoded.reasons),
        (got.decoded.directions[0].phase, want.decoded.directions[0].phase),
        (got.decoded.directions[0].sigma, want.decoded.directions[0].sigma),
    ):
        np.testing.assert_array_equal(a, b)
    assert (want.decoded.reasons == 0).mean() > 0.2


def by_formula(view):
    """Equation 3 in float64: wrapped phase, A, B of the last set, and whether a sample of a pixel is saturated."""
    x = np.array([f for key, f in view.frames if key.set_index == len(view.plan.sets) - 1], np.float64)
    angle = 2 * np.pi * np.arange(len(x)) / len(x)
    c, s = (2 / len(x) * np.tensordot(w(angle), x, 1) for w in (np.cos, np.sin))
    clipped = np.any([f >= view.plan.pixel_format.max_value for _, f in view.frames], axis=0)
    return np.arctan2(s, c), x.mean(0), np.hypot(c, s), clipped


@pytest.mark.parametrize("fmt", FORMATS)
@pytest.mark.parametrize("steps", [3, 4, 5, 8])
def test_sums_are_the_formula_and_all_frames_at_once(fmt, steps):
    rig = rig_of(1190, 29)  # more than two blocks of pixels
    view = drawn(rig, fmt, (4, 4, steps))
    come, begun = summed(view.frames, view, rig)
    assert begun.summed.frames == steps - 1
    got = fast.decode(come, rig, S, "cpu", begun)
    phase, A, B, clipped = by_formula(view)
    top, seen = fmt.max_value, ~clipped
    np.testing.assert_allclose(got.decoded.background[seen], A[seen], atol=2e-6 * top)
    np.testing.assert_allclose(got.decoded.modulation[seen], B[seen], atol=4e-6 * top)
    good = got.decoded.reasons == 0
    off = got.decoded.directions[0].phase[good] - phase[good]
    np.testing.assert_allclose(np.angle(np.exp(1j * off.astype(np.float64))), 0, atol=5e-5)
    same(got, fast.decode(view, rig, S))


def test_it_does_not_matter_which_frames_are_summed_together(rng):
    rig, counts = rig_of(1190, 29), set()
    for fmt, steps in ((PixelFormat.MONO8, 8), (PixelFormat.BAYER_RG12, 5), (PixelFormat.MONO16, 8)):
        view = drawn(rig, fmt, (4, 4, steps))
        want = fast.decode(view, rig, S)
        for _ in range(4):
            come, begun = summed(view.frames, view, rig, rng.random(len(view.frames)) < 0.4)
            counts.add(0 if begun.summed is None else begun.summed.frames)
            same(fast.decode(come, rig, S, "cpu", begun), want)
    assert len(counts) > 2


@pytest.mark.parametrize("fmt", FORMATS[:4])
@pytest.mark.parametrize("steps", [4, 5, 8])
def test_saturated_samples_of_any_frame(fmt, steps):
    rig = rig_of(1190, 29)
    view = drawn(rig, fmt, (4, 4, steps), A=0.8, B=0.4)
    assert np.mean([(f >= fmt.max_value).mean() for _, f in view.frames]) > 0.1
    come, begun = summed(view.frames, view, rig)
    same(fast.decode(come, rig, S, "cpu", begun), fast.decode(view, rig, S))


@pytest.mark.parametrize("n", range(8))
def test_one_saturated_sample_in_one_frame(n):
    rig = rig_of(1190, 29)
    view = drawn(rig, steps=(4, 4, 8))
    view.frames[8 + n][1][11, 700] = 255
    come, begun = summed(view.frames, view, rig)
    got = fast.decode(come, rig, S, "cpu", begun)
    same(got, fast.decode(view, rig, S))


def test_packed_frames_and_rows_that_lie_apart():
    rig = rig_of(1166, 23)
    view = drawn(rig, PixelFormat.MONO12, A=0.6, B=0.5)
    view = replace(view, frames=[(k, np.repeat(packed(f), 2, axis=0)[::2]) for k, f in view.frames])
    come, begun = summed(view.frames, view, rig)
    assert begun.summed.frames == 7
    same(fast.decode(come, rig, S, "cpu", begun), fast.decode(view, rig, S))


def test_sums_of_sets_that_point_the_other_way():
    rig = rig_of(1190, 29)
    for steps in (4, 8):
        view = drawn(rig, steps=(4, 4, steps), flip=(2,))
        come, begun = summed(view.frames, view, rig)
        same(fast.decode(come, rig, S, "cpu", begun), fast.decode(view, rig, S))


def test_late_frames_of_the_finest_set_wait_for_those_before_them():
    rig = rig_of(1190, 29)
    view = drawn(rig, steps=(4, 4, 8))
    frames, counts = view.frames, []
    order = [*range(8), 9, 8, 10, 13, 12, 15, 11, 14]
    beginning = fast.Beginning(view, rig, S)
    for n in order:
        beginning.add(*frames[n])
        begun = beginning.begun
        counts.append(begun.summed.frames if begun and begun.summed else 0)
    assert counts[8:] == [0, 2, 3, 3, 3, 3, 6, 7]
    same(fast.decode(replace(view, frames=beginning.frames), rig, S, "cpu", begun), fast.decode(view, rig, S))


def test_a_frame_of_a_coarse_set_that_is_late_holds_up_the_sums():
    rig = rig_of(1190, 29)
    view = drawn(rig, steps=(4, 4, 8))
    frames = [*view.frames[:3], *view.frames[4:12], view.frames[3], *view.frames[12:]]
    _, early = summed(frames[:11], view, rig)
    assert early is None
    come, begun = summed(frames, view, rig)
    assert begun.summed.frames == 7
    same(fast.decode(come, rig, S, "cpu", begun), fast.decode(view, rig, S))


def test_lost_doubled_and_foreign_frames_are_refused_as_ever():
    rig = rig_of()
    view = drawn(rig, steps=(4, 4, 8))
    key, frame = view.frames[10]
    again = (key, frame.copy())
    for frames, words in (
        ([*view.frames[:10], *view.frames[11:]], "missing"),
        ([*view.frames[:11], again, *view.frames[11:]], "twice"),
        ([*view.frames[:11], again, *view.frames[11:15]], "twice"),
        ([*view.frames[:10], (key, frame[1:]), *view.frames[11:]], "pixels"),
    ):
        come, begun = summed(frames, view, rig)
        with pytest.raises(CaptureError, match=words):
            pipeline.scan_gathered(come, begun, rig, S, "cpu")
        with pytest.raises(CaptureError, match=words):
            pipeline.scan_view(replace(view, frames=iter(frames)), rig, S)


def test_sums_do_not_outlive_another_noise():
    """Where all frames tell another noise than the coarse ones, all is begun anew: nothing of the sums may be used."""
    rig = rig_of(1190, 29)
    view = drawn(rig, steps=(4, 4, 8))
    come, begun = summed(view.frames, view, rig)
    begun.out[5][:] = 7e7
    begun.summed.rest[:] = 99
    wrong = begun._replace(noise=NoiseModel(1.2 * begun.noise.a, 1.2 * begun.noise.b))
    same(fast.decode(come, rig, S, "cpu", wrong), fast.decode(view, rig, S))


def test_frames_that_were_gathered_are_let_go_of_before_the_masks(monkeypatch):
    rig = rig_of()
    view = drawn(rig, steps=(4, 4, 8))
    alive, left = [], []

    def frames():
        for key, frame in view.frames:
            own = frame.copy()
            alive.append(weakref.ref(own))
            yield key, own

    masked = pipeline._masked

    def watched(*args):
        left.append(sum(r() is not None for r in alive))
        return masked(*args)

    monkeypatch.setattr(pipeline, "_masked", watched)
    _, grid = pipeline.scan_view(replace(view, frames=frames()), rig, S)
    assert len(alive) == 16
    assert left == [0]
    _, want = pipeline.scan_view(view, rig, S)
    assert len(view.frames) == 16  # those that were given stay
    np.testing.assert_array_equal(grid.xyz, want.xyz)


def test_nothing_is_summed_while_frames_wait_or_where_it_takes_too_long():
    come = arrival.Arriving()
    assert come.room_s == 0.0
    for n in (0, 1):
        come.put((n, np.zeros((1, 1), np.uint8)))
        assert come.room_s == 0.0
    taken = iter(come)
    next(taken), next(taken)
    assert come.room_s > 0.0
    rig = rig_of(1190, 29)
    view = drawn(rig)
    beginning = fast.Beginning(view, rig, S)
    for n, (key, frame) in enumerate(view.frames):
        beginning.add(key, frame, 1e9 if n == 8 else 1e-9)  # the first tells how long it takes
    assert beginning.begun.summed.frames == 1
