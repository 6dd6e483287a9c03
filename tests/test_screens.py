"""Quick looks against the slow kernels that they spare: what is not asked could not have been rejected or changed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fringescope import calm
from fringescope.kernels import regions, screens, votes

FIELD = np.dstack([np.ones((2, 2, 2)), np.full((2, 2, 1), 0.25)])


def surface(rng, shape, outliers=0.01, masked=0.02, step=False):
    """A bent phase image with noise of known sigma (a mosaic of two), bad points, holes, and a step if wanted."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    sigma = np.where((x + y) % 2 == 0, 0.02, 0.035)
    p = 40 + 0.25 * x - 0.1 * y + 2 * np.cos(x / 25) + 0.3 * np.sin(y / 9)
    p += (x > shape[1] / 2) * 1.5 * step
    p += sigma * rng.normal(size=shape)
    p += (rng.random(shape) < outliers) * rng.normal(0, 0.5, shape)
    reasons = (rng.random(shape) < masked).astype(np.uint16)
    p[reasons != 0] = np.nan
    return p.astype(np.float32), sigma.astype(np.float32), reasons


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.sampled_from([(40, 60), (9, 700), (6, 5), (4, 4), (30, 517)]), st.booleans())
def test_pixels_that_are_not_asked_pass_the_local_test(seed, shape, step):
    rng = np.random.default_rng(seed)
    p, sigma, reasons = surface(rng, shape, step=step)
    found = calm.domains(p, sigma, reasons, FIELD, (4.0, 0.2, 4.0), calm.steps_of(p), 1.0)
    asked = np.zeros(shape, bool)
    screens.rough_pixels(p, sigma, reasons, 1.0, 3.375, 4.5, asked)
    everywhere, out = np.ones(shape, bool), reasons.copy()
    regions.mark_off_surface(
        p, sigma, found.node, found.label, found.kind, everywhere, 2, 6, 4.5, 2.5, np.uint16(2), out,
        np.empty((2, 0, 0), np.float32),
    )  # fmt: skip
    assert not asked[reasons != 0].any()
    assert (out[~asked & (reasons == 0)] == 0).all()


def test_most_of_a_calm_surface_is_not_asked(rng):
    p, sigma, reasons = surface(rng, (200, 300), outliers=0.0, masked=0.0)
    asked = np.zeros(p.shape, bool)
    screens.rough_pixels(p, sigma, reasons, 1.0, 3.375, 4.5, asked)
    assert asked[2:-2, 2:-2].mean() < 0.05
    assert asked[:2].all()
    assert asked[:, -2:].all()


def test_a_bad_point_asks_for_all_around_it(rng):
    p, sigma, reasons = surface(rng, (40, 60), outliers=0.0, masked=0.0)
    p[20, 30] += 0.4
    asked = np.zeros(p.shape, bool)
    screens.rough_pixels(p, sigma, reasons, 1.0, 3.375, 4.5, asked)
    assert asked[18:23, 28:33].all()


@pytest.mark.parametrize("hole", [np.nan, 0.0])
def test_masked_pixels_ask_for_all_around_them(rng, hole):
    p, sigma, reasons = surface(rng, (40, 600), outliers=0.0, masked=0.0)
    reasons[20, 2] = 4
    p[20, 2] = hole
    asked = np.zeros(p.shape, bool)
    screens.rough_pixels(p, sigma, reasons, 1.0, 3.375, 4.5, asked)
    assert (asked | (reasons != 0))[18:23, :5].all()
    assert not asked[20, 2]
    assert asked[2:-2, 10:-2].mean() < 0.05


def torn(p, sigma, reasons, radius, looked=None):
    """Which pixels are asked to vote."""
    shape = p.shape
    looked = np.ones(calm.shape_of(shape), bool) if looked is None else looked
    asked, changed, some = np.zeros(shape, np.uint8), np.zeros(shape, np.int8), np.empty(looked.shape, bool)
    votes.torn(p, sigma, np.float32(0.5), reasons, np.uint16(1), radius, 0.99 * np.pi, looked, asked, changed, some)
    tiles = [asked[8 * t : 8 * t + 8, 8 * u : 8 * u + 8].any() for t, u in np.ndindex(*looked.shape)]
    assert (some | ~np.reshape(tiles, looked.shape)).all()
    return asked != 0


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.sampled_from([(40, 60), (9, 700), (6, 5), (3, 3), (30, 517)]), st.integers(1, 3))
def test_orders_that_are_not_asked_would_not_change(seed, shape, radius):
    rng = np.random.default_rng(seed)
    p, sigma, reasons = surface(rng, shape, outliers=0.0)
    p += (2 * np.pi * (rng.random(shape) < 0.02) * rng.integers(-3, 4, shape)).astype(np.float32)
    asked = torn(p, sigma, reasons, radius)
    changed, looked = np.zeros(shape, np.int8), np.ones(calm.shape_of(shape), bool)
    everywhere, nobody = np.ones(shape, np.uint8), np.zeros((0, 0), np.uint8)
    votes.poll(p, sigma, 0.5, nobody, everywhere, looked, radius, 3, 0.7, 1.2, changed)
    assert np.isin(changed[~asked & (reasons == 0)], (0, 127)).all()


def test_calm_orders_are_not_asked(rng):
    p, sigma, reasons = surface(rng, (60, 900), outliers=0.0, masked=0.0)
    assert not torn(p, sigma, reasons, 2).any()
    p[30, 512] += 2 * np.pi
    asked = torn(p, sigma, reasons, 2)
    assert asked.sum() == 25
    assert asked[28:33, 510:515].all()
    looked = calm.rise(calm.steps_of(p)) * 4 >= 0.99 * np.pi
    assert looked.sum() == 2  # its own tile, and the one to the left, whose last step leads to it
    np.testing.assert_array_equal(torn(p, sigma, reasons, 2, calm.widened(looked, 8)), asked)


@pytest.mark.parametrize("shape", [(100, 150), (33, 7), (1, 90), (90, 1), (8, 8)])
def test_tiles_know_their_steps_and_holes(rng, shape):
    p, _, reasons = surface(rng, shape, masked=0.004)
    reasons[10:30, 10:40] = 2
    steps, cover = calm.steps_of(p), calm.cover_of(reasons)
    for t, u in np.ndindex(*cover.shape):
        mine = np.s_[8 * t : 8 * t + 8, 8 * u : 8 * u + 8]
        masked = reasons[mine] != 0
        assert cover[t, u] == (calm.VOID if masked.all() else calm.MIXED if masked.any() else calm.WHOLE)
        x = np.diff(p[8 * t : 8 * t + 8, 8 * u : 8 * u + 9], axis=1)
        y = np.diff(p[8 * t : 8 * t + 9, 8 * u : 8 * u + 8], axis=0)
        want = []
        for d in (x, y):
            bad = np.isnan(d).any()
            want += [-np.inf if bad else d.min(initial=np.inf), np.inf if bad else d.max(initial=-np.inf)]
        np.testing.assert_array_equal(steps[:, t, u], np.array(want, np.float32))


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.sampled_from([(130, 160), (200, 90)]), st.sampled_from([2, 11]), st.booleans())
def test_masks_do_not_depend_on_which_tiles_are_calm(seed, shape, reach, backward):
    """Looking at every tile gives what looking at the doubtful ones gives, for signs, majorities and loose pixels."""
    rng = np.random.default_rng(seed)
    p, sigma, reasons = surface(rng, shape, outliers=0.0005, masked=0.0005, step=True)
    y, x = np.mgrid[: shape[0], : shape[1]]
    if backward:
        p = np.where(np.hypot(x - 60, y - 50) < 20, 30 - 0.3 * x.astype(np.float32), p).astype(np.float32)
    field = np.dstack([np.full((2, 3), 0.95), np.full((2, 3), -0.3), np.full((2, 3), 0.25)])
    cover, steps = calm.cover_of(reasons), calm.steps_of(p)
    every = np.ones(cover.shape, bool)

    def reversed_(doubtful):
        signs, found, out = np.empty(shape, np.int8), np.empty(cover.shape, bool), reasons.copy()
        regions.gradient_signs(p, sigma, reasons, calm.widened(doubtful, 4), field, reach, 3.0, signs, found)
        regions.mark_backward(signs, calm.widened(found, 2), 2, 0.6, 4, np.uint16(2), out)
        return out

    quiet = calm.growing(steps, cover, field, shape, reach)
    assert quiet.mean() > (0.2 if reach == 2 else 0.0)
    np.testing.assert_array_equal(reversed_(~quiet & (cover != calm.VOID)), reversed_(every))
    assert (reversed_(every) == 2).any() or not backward

    def loose(asked):
        out = reasons.copy()
        regions.mark_loose(p, sigma, reasons, asked, field, 4.0, 0.2, 4.0, 5, np.uint16(2), out)
        return out

    linked = calm.linked(steps, cover, 1.0, around=1)
    assert linked.mean() > 0.2
    np.testing.assert_array_equal(loose(~linked), loose(every))
