"""Quick looks against the slow kernels that they spare: what is not asked could not have been rejected or changed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fringescope.kernels import fringes, regions, screens

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
    label = np.empty(shape, np.int32)
    regions.domains(p, sigma, reasons, FIELD, 4.0, 0.2, 4.0, label)
    asked = np.zeros(shape, bool)
    screens.rough_pixels(p, sigma, reasons, 1.0, 3.375, asked)
    out, roughness = np.empty_like(p), np.empty_like(p)
    regions.local_surface(p, sigma, label, np.ones(shape, bool), 2, 6, out, roughness)
    calm = ~asked
    assert (reasons[calm] == 0).all()
    assert (out[calm] <= 4.5).all()
    assert (roughness[calm] <= 2.5).all()


def test_most_of_a_calm_surface_is_not_asked(rng):
    p, sigma, reasons = surface(rng, (200, 300), outliers=0.0, masked=0.0)
    asked = np.zeros(p.shape, bool)
    screens.rough_pixels(p, sigma, reasons, 1.0, 3.375, asked)
    assert asked[2:-2, 2:-2].mean() < 0.05
    assert asked[:2].all()
    assert asked[:, -2:].all()


def test_a_bad_point_asks_for_all_around_it(rng):
    p, sigma, reasons = surface(rng, (40, 60), outliers=0.0, masked=0.0)
    p[20, 30] += 0.4
    asked = np.zeros(p.shape, bool)
    screens.rough_pixels(p, sigma, reasons, 1.0, 3.375, asked)
    assert asked[18:23, 28:33].all()


@pytest.mark.parametrize("hole", [np.nan, 0.0])
def test_masked_pixels_ask_for_all_around_them(rng, hole):
    p, sigma, reasons = surface(rng, (40, 600), outliers=0.0, masked=0.0)
    reasons[20, 2] = 4
    p[20, 2] = hole
    asked = np.zeros(p.shape, bool)
    screens.rough_pixels(p, sigma, reasons, 1.0, 3.375, asked)
    assert asked[18:23, :5].all()
    assert asked[2:-2, 10:-2].mean() < 0.05


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.sampled_from([(40, 60), (9, 700), (6, 5), (3, 3), (30, 517)]), st.integers(1, 3))
def test_orders_that_are_not_asked_would_not_change(seed, shape, radius):
    rng = np.random.default_rng(seed)
    p, _, reasons = surface(rng, shape, outliers=0.0)
    p += (2 * np.pi * (rng.random(shape) < 0.02) * rng.integers(-3, 4, shape)).astype(np.float32)
    voters = np.where(reasons == 0, p, np.float32(np.nan))
    asked, everywhere = np.empty(shape, bool), np.ones(shape, bool)
    screens.torn_orders(voters, radius, 0.99 * np.pi, asked)
    out, changed = np.empty_like(p), np.zeros(shape, np.int8)
    fringes.order_votes(p, voters, everywhere, radius, 3, 0.7, 1.2, out, changed)
    calm = ~asked & (reasons == 0)
    np.testing.assert_array_equal(out[calm], p[calm])
    assert np.isin(changed[calm], (0, 127)).all()


def test_calm_orders_are_not_asked(rng):
    p, _, _ = surface(rng, (60, 900), outliers=0.0, masked=0.0)
    asked = np.empty(p.shape, bool)
    screens.torn_orders(p, 2, 0.99 * np.pi, asked)
    assert not asked.any()
    p[30, 512] += 2 * np.pi
    screens.torn_orders(p, 2, 0.99 * np.pi, asked)
    assert asked.sum() == 25
    assert asked[28:33, 510:515].all()
