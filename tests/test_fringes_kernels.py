"""The kernels of fringes, rays and regions against their slow twins."""

import gc
import math
import weakref
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fringescope import calm, geometry, phase
from fringescope.errors import CaptureError
from fringescope.kernels import fringes as kernels
from fringescope.kernels import regions, views, votes
from fringescope.types import FringeSet, NoiseModel
from tests import fuse_scenes as scenes
from tests.reference import fringes as reference
from tests.reference import regions as slow

TWO_PI = 2 * math.pi
seeds = st.integers(0, 2**32 - 1)


def accumulated(frames, top, order=None):
    """Frames (N, H, W) through the accumulator, in any order."""
    sums = phase.FringeSums(FringeSet((0.01, 0.0), len(frames)), top)
    for n in order if order is not None else range(len(frames)):
        sums.add(int(n), frames[n])
    return sums.finish()


# ------------------------------------------------------------------------------------------------- frames to the phase


@settings(max_examples=60)
@given(st.integers(3, 16), st.integers(8, 16), seeds)
def test_wrap_is_the_least_squares_sinusoid_of_what_is_not_saturated(steps, bits, seed):
    rng = np.random.default_rng(seed)
    top = 2**bits - 1
    A, B = rng.uniform(0.3, 1.1, (5, 7)) * top, rng.uniform(0.02, 0.6, (5, 7)) * top
    phi = rng.uniform(-np.pi, np.pi, (5, 7))
    n = np.arange(steps)[:, None, None]
    raw = A + B * np.cos(phi - TWO_PI * n / steps) + rng.normal(0, 0.01 * top, (steps, 5, 7))
    frames = np.clip(np.rint(raw), 0, top).astype(np.uint8 if bits == 8 else np.uint16)
    m = accumulated(frames, top, rng.permutation(steps))
    for i, j in np.ndindex(5, 7):
        keep = frames[:, i, j] < top
        want_phase, want_A, want_B, want_variance = reference.sinusoid(frames[:, i, j], top)
        assert [bool(int(m.clipped[i, j]) >> k & 1) for k in range(steps)] == (~keep).tolist()
        if keep.sum() < 3:
            assert m.modulation[i, j] == 0
            assert m.background[i, j] == pytest.approx(want_A if keep.any() else top)
            assert math.isnan(m.variance[i, j])
            continue
        M = reference.design(steps)[keep]
        gain = np.linalg.cond(M) ** 2  # what a rounding of the sums may do to a fit of few neighbouring samples
        codes = 3e-7 * gain * top
        assert m.background[i, j] == pytest.approx(want_A, abs=codes)
        assert m.modulation[i, j] == pytest.approx(want_B, abs=codes)
        off = abs(reference.wrapped(float(m.phase[i, j]) - want_phase))
        assert off < codes / want_B + 1e-6
        if keep.sum() == 3:
            assert math.isnan(m.variance[i, j])
        else:
            # what float32 does to the sums of squares, or float64 to those of deep pixels
            rounding = 1.2e-7 * steps * top**2 if top < 1024 else 1e-3 * want_variance + 1e-15 * steps * top**2
            assert m.variance[i, j] == pytest.approx(want_variance, rel=2e-3, abs=gain * rounding)


def test_a_saturated_sample_does_not_pull_the_phase():
    """The crest of a fringe is cut off; a fit that took it at its word would be wrong by several hundredths."""
    phi, n = 0.2, np.arange(8)
    samples = 200 + 90 * np.cos(phi - TWO_PI * n / 8)
    frames = np.clip(np.rint(samples), 0, 255).astype(np.uint8)[:, None, None]
    assert 1 <= (frames == 255).sum() <= 4
    m = accumulated(frames, 255)
    assert m.phase[0, 0] == pytest.approx(phi, abs=0.01)
    assert m.background[0, 0] == pytest.approx(200, abs=1)
    assert m.modulation[0, 0] == pytest.approx(90, abs=1)
    naive = np.arctan2(np.sin(TWO_PI * n / 8) @ frames[:, 0, 0], np.cos(TWO_PI * n / 8) @ frames[:, 0, 0])
    assert abs(naive - phi) > 0.01 > 5 * abs(m.phase[0, 0] - phi)


def test_the_sign_of_the_phase_by_hand():
    """I_n = A + B cos(Phi - 2 pi n / 4): at Phi = +90 degrees frame 1, not frame 3, is the bright one."""
    frames = np.array([100, 150, 100, 50], np.uint8)[:, None, None]
    m = accumulated(frames, 255)
    assert m.phase[0, 0] == pytest.approx(np.pi / 2, abs=1e-6)
    assert (m.background[0, 0], m.modulation[0, 0]) == pytest.approx((100, 50), abs=1e-4)


def test_sums_hold_no_frames():
    sums = phase.FringeSums(FringeSet((0.01, 0.0), 64), 255)
    held, sizes = [], []
    for n in range(64):
        frame = np.full((40, 50), n, np.uint8)
        held.append(weakref.ref(frame))
        sums.add(n, frame)
        del frame
        own = gc.get_referents(*gc.get_referents(sums.__dict__))
        sizes.append(sum(a.nbytes for a in own if isinstance(a, np.ndarray)))
    gc.collect()
    assert not any(r() is not None for r in held)
    assert len(set(sizes[1:])) == 1


def test_sums_refuse_what_does_not_fit():
    frame = np.zeros((4, 6), np.uint8)
    sums = phase.FringeSums(FringeSet((0.01, 0.0), 4), 255)
    sums.add(2, frame)
    with pytest.raises(CaptureError, match=r"frame 2 of a 4-step set came twice"):
        sums.add(2, frame)
    with pytest.raises(CaptureError, match="out of range"):
        sums.add(4, frame)
    with pytest.raises(CaptureError, match=r"frame 0 is 6 x 5 pixels; the set began with 6 x 4"):
        sums.add(0, np.zeros((5, 6), np.uint8))
    with pytest.raises(CaptureError, match=r"got 1 frames; missing \[0, 1, 3\]") as e:
        sums.finish()
    assert "\n" not in str(e.value)


# ------------------------------------------------------------------------------------------------------ sigma and noise


@settings(max_examples=60)
@given(st.integers(3, 16), seeds)
def test_phase_sigma_is_the_propagated_noise_of_the_samples(steps, seed):
    """Shot noise differs from sample to sample; only for three steps does that leave a trace (third harmonic)."""
    rng = np.random.default_rng(seed)
    A, B, phi = rng.uniform(60, 200), rng.uniform(5, 50), rng.uniform(-np.pi, np.pi)
    a, b = rng.uniform(0.1, 3), rng.uniform(0, 0.1)
    clipped = 0
    if steps > 4 and rng.random() < 0.6:
        for n in rng.choice(steps, rng.integers(1, steps // 2 + 1), replace=False):
            clipped |= 1 << int(n)
    keep = np.array([not clipped >> n & 1 for n in range(steps)])
    if clipped:
        variances = np.full(steps, a + b * A)  # with clipped samples the mean level stands for all
    else:
        variances = a + b * (A + B * np.cos(phi - TWO_PI * np.arange(steps) / steps))
    if keep.sum() < 3 or np.linalg.cond(reference.design(steps)[keep]) > 1e3:
        return
    one = np.ones((1, 1), np.float32)
    out, lost = np.empty((1, 1), np.float32), np.empty((1, 1), np.uint8)
    bits = np.full((1, 1), clipped, np.uint64)
    kernels.phase_sigma(one * phi, one * A, one * B, bits, steps, a, b, steps, out, lost)
    assert lost[0, 0] == steps - keep.sum()
    assert out[0, 0] == pytest.approx(reference.sigma(np.float32(phi), np.float32(B), keep, variances), rel=1e-3)
    if clipped:
        kernels.phase_sigma(one * phi, one * A, one * B, bits, steps, a, b, int(lost[0, 0]) - 1, out, lost)
        assert math.isinf(out[0, 0])


@pytest.mark.parametrize(("steps", "clipped"), [(3, 0), (4, 0), (8, 0), (8, 2), (12, 4)])
def test_phase_sigma_is_the_spread_of_noisy_frames(steps, clipped, rng):
    """Monte Carlo, 12-bit: within 10 % at every phase; three steps keep their term in cos 3 phi."""
    top, A, B = 4095, 1500.0, 900.0
    a, b = (40.0, 1.2) if not clipped else (900.0, 0.0)
    phi = np.linspace(-3, 3, 9)[:, None] if not clipped else np.full((9, 1), TWO_PI * (clipped - 1) / 2 / steps)
    n = np.arange(steps)[:, None, None]
    clean = A + B * np.cos(phi - TWO_PI * n / steps) + np.zeros((steps, 9, 2500))
    frames = np.rint(clean + rng.normal(size=clean.shape) * np.sqrt(a + b * clean)).clip(0, top - 1).astype(np.uint16)
    if clipped:
        frames[:clipped] = top
    m = accumulated(frames, top)
    out, lost = np.empty_like(m.phase), np.empty(m.phase.shape, np.uint8)
    kernels.phase_sigma(m.phase, m.background, m.modulation, m.clipped, steps, a + 1 / 12, b, steps, out, lost)
    spread = np.std(reference.wrapped(m.phase - phi), axis=1)
    np.testing.assert_allclose(out.mean(axis=1), spread, rtol=0.1)
    if steps == 3:
        assert spread.max() / spread.min() > 1.3  # the term is there: a formula without it cannot pass above


@pytest.mark.parametrize(("bits", "a", "b"), [(8, 0.8, 0.02), (12, 30.0, 0.4), (16, 900.0, 4.0)])
@pytest.mark.parametrize("steps", [3, 5, 8])
def test_noise_is_found_in_the_capture(bits, a, b, steps, rng):
    """`a + b I` within 15 % wherever the image has light, `b` itself too; rounding to codes adds its twelfth to a."""
    top = 2**bits - 1
    A = np.linspace(0.03, 0.6, 160)[None, :] * top + np.zeros((160, 160))
    B = 0.4 * A
    measured = []
    for period in (300.0, 30.0):
        phi = TWO_PI * np.mgrid[:160, :160][1] / period
        n = np.arange(steps)[:, None, None]
        clean = A + B * np.cos(phi - TWO_PI * n / steps)
        frames = np.rint(clean + rng.normal(size=clean.shape) * np.sqrt(a + b * clean)).clip(0, top)
        measured.append(accumulated(frames.astype(np.uint8 if bits == 8 else np.uint16), top))
    noise = phase.estimate_noise(measured, top)
    assert noise.source == "residuals"
    for share in (0.05, 0.2, 0.5):
        level = share * top
        assert noise.a + noise.b * level == pytest.approx(a + 1 / 12 + b * level, rel=0.15)
    assert noise.b == pytest.approx(b, rel=0.15)


def test_noise_of_a_black_view_is_the_default():
    m = accumulated(np.zeros((4, 30, 30), np.uint8), 255)
    assert phase.estimate_noise([m], 255).source == "default"


def test_brackets_merge_by_inverse_variance(rng):
    phases = rng.uniform(-np.pi, np.pi, (3, 4, 5)).astype(np.float32)
    phases[1:] = phases[0] + rng.normal(0, 0.3, (2, 4, 5))
    sigmas = rng.uniform(0.01, 1, (3, 4, 5)).astype(np.float32)
    sigmas[rng.random((3, 4, 5)) < 0.3] = np.inf
    sigmas[:, 0, 0] = np.inf
    levels, modulations = (rng.uniform(1, 99, (3, 4, 5)).astype(np.float32) for _ in range(2))
    out = np.empty((5, 4, 5), np.float32)
    kernels.merge_brackets(phases, levels, modulations, sigmas, out)
    assert math.isinf(out[3, 0, 0])
    for i, j in np.argwhere(np.isfinite(sigmas).any(0)):
        want_phase, want_sigma = reference.merge(phases[:, i, j], sigmas[:, i, j])
        assert abs(reference.wrapped(float(out[0, i, j]) - want_phase)) < 1e-5
        assert out[3, i, j] == pytest.approx(want_sigma, rel=1e-5)
        best = sigmas[:, i, j].argmin()
        assert (out[1, i, j], out[2, i, j], out[4, i, j]) == (levels[best, i, j], modulations[best, i, j], best)


# ------------------------------------------------------------------------------------------------------------ the order

PLANS = {
    "hierarchical": (1 / 1200, 1 / 180, 1 / 36),
    "beat": (1 / 33, 1 / 27),
    "three beats": (1 / 35, 1 / 31, 1 / 28),
    "wrapping coarse, odd ratios": (1 / 700, 1 / 170, 1 / 36),
    "single": (1 / 1200,),
}


@settings(max_examples=40)
@given(st.sampled_from(sorted(PLANS)), seeds)
def test_unwrap_finds_what_a_search_over_all_orders_finds(name, seed):
    rng = np.random.default_rng(seed)
    freq = np.array(PLANS[name])
    field = {"beat": 140.0, "three beats": 250.0}.get(name, 1100.0)
    x = rng.uniform(0, field, (6, 8))
    sigma = rng.uniform(0.02, 0.12)
    truth = TWO_PI * x * freq[-1]
    noisy = TWO_PI * x * freq[:, None, None] + rng.normal(0, sigma, (len(freq), 6, 8))
    phases = reference.wrapped(noisy).astype(np.float32)
    sigmas = np.full(phases.shape, sigma, np.float32)
    hi = TWO_PI * field * freq[-1]
    bounds = np.array([-1.0, hi + 1, -1.0, hi + 1])[:, None, None] * np.ones((4, 2, 2))
    out, margin = np.empty((6, 8), np.float32), np.empty((6, 8), np.float32)
    none = np.zeros((0, 0), np.float32)
    kernels.unwrap(phases, sigmas, freq, bounds, 16.0, none, 0.0, 1.0, out, margin)
    sure = 0
    for i, j in np.ndindex(6, 8):
        want, gap = reference.search(phases[:, i, j].astype(float), sigmas[:, i, j], freq, -1.0, hi + 1)
        if margin[i, j] >= 3 and gap > 3:
            sure += 1
            assert out[i, j] == pytest.approx(want, abs=1e-3)
        if margin[i, j] > 6:
            assert out[i, j] == pytest.approx(truth[i, j], abs=6 * sigma)
        # whatever the order, the phase itself is the finest set's, untouched
        assert abs(reference.wrapped(float(out[i, j]) - float(phases[-1, i, j]))) < 1e-4
    assert name != "hierarchical" or sure >= 24


def test_bounds_choose_the_order_and_unexpected_places_cost():
    """One wrapping set alone: only the bounds tell; outside the expected part it must pay, and none fits: NaN."""
    phases, sigmas = np.full((1, 3, 4), 0.5, np.float32), np.full((1, 3, 4), 0.1, np.float32)
    out, margin = np.empty((3, 4), np.float32), np.empty((3, 4), np.float32)
    none = np.zeros((0, 0), np.float32)
    flat = np.ones((4, 2, 2))

    def run(lo, hi, elo, ehi):
        limits = np.array([lo, hi, elo, ehi], float)[:, None, None] * flat
        kernels.unwrap(phases, sigmas, np.array([0.01]), limits, 16.0, none, 0.0, 1.0, out, margin)
        return out[1, 1], margin[1, 1]

    assert run(20, 26, 20, 26) == (pytest.approx(0.5 + 4 * TWO_PI, abs=1e-4), pytest.approx(99))
    assert run(13, 26, 20, 26) == (pytest.approx(0.5 + 4 * TWO_PI, abs=1e-4), pytest.approx(4, abs=1e-3))
    assert run(13, 26, 13, 26)[1] == pytest.approx(0, abs=1e-3)
    assert math.isnan(run(14, 18, 14, 18)[0])
    slanted = flat * np.array([20, 26, 20, 26.0])[:, None, None]
    slanted[:, :, 1] += TWO_PI  # the right edge of the image lies one order further
    kernels.unwrap(phases, sigmas, np.array([0.01]), slanted, 16.0, none, 0.0, 1.0, out, margin)
    np.testing.assert_allclose(out[:, [0, 3]], 0.5 + TWO_PI * np.array([[4, 5]] * 3), atol=1e-4)


def test_a_set_of_infinite_sigma_is_passed_over():
    freq = np.array([1 / 1200, 1 / 180, 1 / 36])
    x = np.linspace(10, 1000, 20).reshape(1, 4, 5)
    phases = reference.wrapped(TWO_PI * x * freq[:, None, None]).astype(np.float32)
    sigmas = np.full(phases.shape, 0.005, np.float32)
    phases[1, :2], sigmas[1, :2] = 2.0, np.inf
    phases[0, 2:], sigmas[0, 2:] = 2.0, np.inf
    bounds = np.ones((4, 2, 2)) * np.array([0, 180, 0, 180.0])[:, None, None]
    bounds[:, 1] = bounds[:, 1]
    out, margin = np.empty((4, 5), np.float32), np.empty((4, 5), np.float32)
    kernels.unwrap(phases, sigmas, freq, bounds, 16.0, np.zeros((0, 0), np.float32), 0.0, 1.0, out, margin)
    np.testing.assert_allclose(out[:2], TWO_PI * x[0, :2] / 36, atol=1e-3)
    assert (margin[2:] < 3).all()  # without the coarsest set several orders fit, and the margin says so
    sigmas[2, 0, 0] = np.inf
    kernels.unwrap(phases, sigmas, freq, bounds, 16.0, np.zeros((0, 0), np.float32), 0.0, 1.0, out, margin)
    assert math.isnan(out[0, 0])


@settings(max_examples=15)
@given(seeds)
def test_order_votes_equal_their_twin(seed):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:12, :15]
    smooth = 0.3 * x + 0.2 * y + 3 * (x > 8) + rng.normal(0, 0.1, x.shape)
    p = (smooth + TWO_PI * rng.choice([0, 0, 0, 0, 1, -1, 2, 12], x.shape)).astype(np.float32)
    p[rng.random(p.shape) < 0.1] = np.nan
    voters = np.where(rng.random(p.shape) < 0.2, np.float32(np.nan), p)
    sigma = np.where(np.isnan(voters), np.float32(1), np.float32(0.1))
    changed, moved = np.empty(p.shape, np.int8), np.zeros(p.shape, np.uint8)
    asked, looked, some = np.ones(p.shape, np.uint8), np.ones((2, 2), bool), np.empty((2, 2), bool)
    votes.poll(p, sigma, 0.5, np.zeros((0, 0), np.uint8), asked, looked, 2, 6, 0.7, 0.9, changed)
    want, want_changed = reference.votes(p, voters, 2, 6, 0.7, 0.9)
    np.testing.assert_array_equal(changed, want_changed)
    barred = np.isnan(voters).astype(np.uint8) * np.uint8(2)  # those who are in doubt do not vote
    again = np.empty(p.shape, np.int8)
    votes.poll(p, np.full_like(sigma, 0.1), 0.5, barred, asked, looked, 2, 6, 0.7, 0.9, again)
    np.testing.assert_array_equal(again, want_changed)
    reasons = np.full(p.shape, 9, np.uint16)
    votes.move(changed, asked, looked, np.uint16(8), np.uint8(1), p, reasons, moved, some)
    np.testing.assert_allclose(p, want, atol=1e-4)
    turned = (changed != 0) & (np.abs(changed.astype(int)) <= 8)
    np.testing.assert_array_equal(moved != 0, turned)
    np.testing.assert_array_equal(reasons, np.where(turned, 1, 9))
    assert some.any() == turned.any()


@pytest.mark.parametrize("reading", ["inverse", "threshold"])
def test_gray_bits_are_the_reflected_code(reading):
    words = reference.gray_words(6)
    assert all(sum(a != b for a, b in zip(w, v, strict=True)) == 1 for w, v in pairwise(words))
    code, contrast = np.zeros((1, 64), np.int32), np.zeros((1, 64), np.float32)
    for n in range(6):
        frame = np.array([[30 + 100 * w[n] for w in words]], np.uint8)
        inverse = 160 - frame if reading == "inverse" else np.zeros((0, 0), np.uint8)
        kernels.gray_bit(frame, inverse, np.full((1, 64), 80, np.float32), 5.0, n, code, contrast)
    np.testing.assert_array_equal(code[0], np.arange(64))
    np.testing.assert_array_equal(contrast, 100 if reading == "inverse" else 50)


# -------------------------------------------------------------------------------------------- neighbourhoods (regions)


def bumpy(rng, shape=(16, 20)):
    """A phase image with a step, noise, outliers and masked pixels; sigma and reasons."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    p = 0.25 * x + 0.1 * y + 0.01 * (x - 9) * (y - 5) + 4.0 * (x + y > 22)
    sigma = rng.uniform(0.02, 0.08, shape)
    p = p + sigma * rng.normal(size=shape) + rng.choice([0, 0, 0, 0, 0, 0, 0, 1.0], shape)
    return p.astype(np.float32), sigma.astype(np.float32), (rng.random(shape) < 0.12).astype(np.uint16)


@settings(max_examples=15)
@given(seeds)
def test_gradient_votes_equal_their_twins(seed):
    rng = np.random.default_rng(seed)
    p, sigma, reasons = bumpy(rng)
    field = np.dstack([rng.normal(1.5, 1, (3, 4)), rng.normal(0.5, 1, (3, 4)), np.ones((3, 4))])
    asked, backward = np.ones((2, 3), bool), np.empty((2, 3), bool)
    signs = np.empty(p.shape, np.int8)
    regions.gradient_signs(p, sigma, reasons, asked, field, 2, 3.0, signs, backward)
    want = slow.gradient_signs(p, sigma, reasons, field, 2, 3.0)
    np.testing.assert_array_equal(signs, want)
    assert (signs == 1).any()
    tiles = [[(want[y : y + 8, x : x + 8] < 0).any() for x in (0, 8, 16)] for y in (0, 8)]
    np.testing.assert_array_equal(backward, tiles)
    mixed = np.where(rng.random(p.shape) < 0.5, -signs, signs).astype(np.int8)
    before = reasons.copy()
    regions.mark_backward(mixed, asked, 2, 0.6, 4, np.uint16(2), reasons)
    back = slow.majority_backward(mixed, 2, 0.6, 4)
    np.testing.assert_array_equal(reasons, np.where(back & (before == 0), 2, before))


@settings(max_examples=15)
@given(seeds)
def test_domains_equal_scipy_components(seed):
    rng = np.random.default_rng(seed)
    p, sigma, reasons = bumpy(rng)
    field = np.dstack([np.ones((3, 4, 2)), rng.uniform(0.05, 0.2, (3, 4, 1))])
    factor, floor, noise = 2.5, 0.2, 2.0
    limit = np.maximum(factor * slow.spread(field, p.shape)[..., 2], floor), noise
    out = reasons.copy()
    every, pending = np.ones((2, 3), bool), np.uint16(32)
    regions.mark_loose(p, sigma, out, every, field, factor, floor, noise, 5, pending)
    regions.confirm(out, every, pending, np.uint16(4))
    np.testing.assert_array_equal(out == 4, slow.loose_pixels(p, sigma, reasons, limit, 5))
    same_domains(p, sigma, reasons, field, (factor, floor, noise), limit)


def labels(found, shape):
    """The domain of every pixel, -1 = masked."""
    out = np.empty(shape, np.int32)
    for i, j in np.ndindex(*shape):
        t, u = i // 8, j // 8
        alone = 0 if found.kind[t, u] else 8 * (i % 8) + j % 8
        out[i, j] = found.label[found.node[t, u] + alone]
    return out


def same_domains(p, sigma, reasons, field, limits, limit):
    """Domains over calm tiles and single pixels are scipy's over pixels; returns the share of calm tiles."""
    least_step = max(limits[0] * field[..., 2].min(), limits[1])
    found = calm.domains(p, sigma, reasons, field, limits, calm.steps_of(p), least_step)
    label, sizes = labels(found, p.shape), found.sizes
    want = slow.domains(p, sigma, reasons, limit)
    np.testing.assert_array_equal(label < 0, want == 0)
    assert len(sizes) == want.max()
    pairs = set(zip(label[label >= 0].tolist(), want[want > 0].tolist(), strict=True))
    assert len(pairs) == len(sizes)  # a one-to-one renaming
    np.testing.assert_array_equal(sizes, np.bincount(label[label >= 0], minlength=len(sizes)))
    marked = reasons.copy()
    found.mark_small(20, np.uint16(2), marked)
    np.testing.assert_array_equal(marked == 2, (label >= 0) & (sizes[label] < 20))
    return float((found.kind == 1).mean())


@settings(max_examples=15)
@given(seeds, st.sampled_from([(150, 60), (70, 203), (33, 7), (1, 90), (200, 1)]))
def test_domains_of_calm_tiles_in_bands_equal_scipy_components(seed, shape):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]]
    p = 0.25 * x + 0.1 * y + 3.0 * (np.hypot(x - 30, y - 40) < 25) + 4.0 * (y % 64 == 63)
    sigma = np.full(shape, 0.02)
    p = (p + sigma * rng.normal(size=shape)).astype(np.float32)
    reasons = (rng.random(shape) < 0.004).astype(np.uint16)
    for _ in range(6):  # holes of every width, lines of masked pixels too
        a, b, h, w = rng.integers(0, shape[0]), rng.integers(0, shape[1]), *rng.integers(1, 30, 2)
        reasons[a : a + h, b : b + w] = 1
    p[(reasons != 0) & (rng.random(shape) < 0.5)] = np.nan
    field = np.dstack([np.ones((3, 4, 2)), rng.uniform(0.2, 0.3, (3, 4, 1))])
    limit = np.maximum(4.0 * slow.spread(field, p.shape)[..., 2], 0.2), 4.0
    share = same_domains(p, sigma.astype(np.float32), reasons, field, (4.0, 0.2, 4.0), limit)
    assert share > 0.2 or min(shape) < 60


@settings(max_examples=8)
@given(seeds)
def test_local_surface_equals_robust_least_squares(seed):
    rng = np.random.default_rng(seed)
    p, sigma, reasons = bumpy(rng, (12, 14))
    field = np.dstack([np.ones((2, 2, 2)), np.full((2, 2, 1), 0.25)])
    found = calm.domains(p, sigma, reasons, field, (4.0, 0.2, 4.0), calm.steps_of(p), 1.0)
    label = labels(found, p.shape)
    out, roughness = measures = np.full((2, *p.shape), np.nan, np.float32)
    marked = reasons.copy()
    regions.mark_off_surface(
        p, sigma, found.node, found.label, found.kind, np.ones(p.shape, bool), 2, 6, 2.0, 1.5, np.uint16(2), marked,
        measures,
    )  # fmt: skip
    np.testing.assert_array_equal(marked == 2, (reasons == 0) & ~((out <= 2.0) & (roughness <= 1.5)))
    seen = 0
    for i, j in np.ndindex(*p.shape):
        want, want_roughness = slow.local_distance(p, sigma, label, 2, 6, i, j)
        if math.isnan(want) or math.isnan(out[i, j]):
            assert math.isnan(want) == math.isnan(out[i, j]), (i, j)
            continue
        seen += 1
        assert out[i, j] == pytest.approx(want, rel=2e-2, abs=2e-3)
        assert roughness[i, j] == pytest.approx(want_roughness, rel=1e-2, abs=1e-3)
    assert seen > 20


@settings(max_examples=8)
@given(seeds)
def test_cross_examination_equals_its_twin(seed):
    rng = np.random.default_rng(seed)
    r = scenes.rig(2, 24, 18)
    hit = scenes.ball()
    own, other = (scenes.grid(r, i, hit, 0.02, rng, keep=lambda p, *_: rng.random(p.shape[:2]) > 0.05) for i in (0, 1))
    xyz = own.xyz + np.where(rng.random(own.sigma.shape) < 0.3, rng.normal(0, 3, own.sigma.shape), 0)[..., None]
    xyz = xyz.astype(np.float32)
    camera = r.cameras[1]
    mine, others = (
        views.View(x.reshape(-1), s.reshape(-1), *s.shape, geometry.pose_vector(c.pose), geometry.lens_vector(c.lens))
        for x, s, c in ((xyz, own.sigma, r.cameras[0]), (other.xyz, other.sigma, camera))
    )
    bad, lost = np.zeros(own.sigma.shape, np.uint8), np.zeros(len(own.sigma), np.int64)
    views.contradicted(mine, (others,), 1, 6.0, 0.5, np.ones((1, 3, 3), np.bool_), bad, lost)
    said = np.zeros(own.sigma.shape, int)
    for i, j in np.argwhere(np.isfinite(xyz[..., 0])):
        said[i, j] = views.examine(*map(float, xyz[i, j]), float(own.sigma[i, j]), others, 6.0, 0.5)
    want = np.zeros(own.sigma.shape, int)
    for i, j in np.argwhere(np.isfinite(xyz[..., 0])):
        want[i, j] = slow.cross_examine(
            xyz[i, j], own.sigma[i, j], other.xyz, other.sigma, camera.pose, camera.lens, 6.0, 0.5
        )
    np.testing.assert_array_equal(said, want)
    np.testing.assert_array_equal(bad != 0, want == -1)
    np.testing.assert_array_equal(lost, bad.sum(1))
    assert {-1, 0, 1} <= set(want.ravel())


def looks_of(r, grids):
    """Grids as `kernels.views` takes them, and their planes."""
    looks, planes = [], []
    for g in grids:
        c = r.cameras[g.view]
        pose, lens = geometry.pose_vector(c.pose), geometry.lens_vector(c.lens)
        looks.append(views.View(g.xyz.reshape(-1), g.sigma.reshape(-1), *g.sigma.shape, pose, lens))
        planes.append(np.full((*calm.shape_of(g.sigma.shape), 16), 7.0, np.float32))
        views.planes(looks[-1], geometry.centre(c.pose), planes[-1])
    return looks, planes


@settings(max_examples=8, deadline=None)
@given(seeds)
def test_planes_of_tiles_hold_their_points(seed):
    rng = np.random.default_rng(seed)
    r = scenes.rig(1, 44, 35)
    g = scenes.grid(r, 0, scenes.ball(), 0.01, rng, keep=lambda p, *_: rng.random(p.shape[:2]) > 0.01)
    (_, (found,)) = looks_of(r, [g])
    eye, kinds = geometry.centre(r.cameras[0].pose), set()
    for t, u in np.ndindex(*found.shape[:2]):
        p = g.xyz[8 * t : 8 * t + 8, 8 * u : 8 * u + 8].astype(float)
        sigma, got = g.sigma[8 * t : 8 * t + 8, 8 * u : 8 * u + 8], found[t, u].astype(float)
        whole, some = p.shape == (8, 8, 3) and np.isfinite(p).all(), np.isfinite(p[..., 0]).any()
        kinds.add((whole, some))
        assert np.isnan(got[9]) != whole
        assert np.isnan(got[0]) != some
        if not whole:
            continue
        middle = p.mean((0, 1))
        a, b = ((p[:, 4:] - p[:, :4]).mean((0, 1)) * 3.5 / 4, (p[4:] - p[:4]).mean((0, 1)) * 3.5 / 4)
        np.testing.assert_allclose(got[:9], np.concatenate([middle, a, b]), atol=2e-4)
        n = np.cross(got[3:6], got[6:9])
        n *= np.sign(n @ (eye - middle)) / np.linalg.norm(n)
        np.testing.assert_allclose(got[9:12], n, atol=1e-4)
        y, x = (np.mgrid[:8, :8] - 3.5) / 3.5
        away = p - (got[:3] + x[..., None] * got[3:6] + y[..., None] * got[6:9])
        s = away @ got[9:12]
        want = [s.min(), s.max(), np.linalg.norm(away, axis=-1).max(), sigma.min()]
        np.testing.assert_allclose(got[12:], want, atol=1e-5)
    assert {(True, True), (False, True)} <= kinds


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_no_denied_point_hides_in_a_tile_that_is_not_looked_at(seed):
    """Balls and plates, steps, points that fly by little and by much, views that are off against each other."""
    rng = np.random.default_rng(seed)
    r = scenes.rig(3, 160, 120, float(rng.uniform(5, 40)))
    hit = scenes.ball(float(rng.uniform(4, 9))) if rng.random() < 0.5 else scenes.plane(rng.normal([0, 0, 1], 0.3))
    found = [scenes.grid(r, i, hit, 0.01, rng) for i in range(3)]
    for g in found:
        ray = geometry.centre(r.cameras[g.view].pose) - g.xyz
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        g.xyz[:] += ray * np.float32(rng.normal(0, 0.08))
        g.xyz[:] += ray * np.where(rng.random(g.sigma.shape) < 1e-3, rng.exponential(0.3, g.sigma.shape), 0)[..., None]
        row, column = rng.integers(0, 100, 2)
        g.xyz[row : row + 20, column : column + 13] += ray[row : row + 20, column : column + 13] * np.float32(0.2)
    looks, planes = looks_of(r, found)
    limits, shape, skipped = (6.0, 0.5), found[0].sigma.shape, 0
    for i in range(3):
        others = [n for n in range(3) if n != i]
        asked = np.ones((2, *planes[i].shape[:2]), np.bool_)
        said = []
        for some in (True, False):
            if not some:
                for k, n in enumerate(others):
                    views.doubtful(looks[i], planes[i], looks[n], planes[n], *limits, asked[k])
            bad, lost = np.zeros(shape, np.uint8), np.zeros(len(found[i].sigma), np.int64)
            views.contradicted(looks[i], tuple(looks[n] for n in others), len(others), *limits, asked, bad, lost)
            said.append(bad)
        np.testing.assert_array_equal(*said)
        skipped += int((~asked & np.isfinite(planes[i][..., 0])).sum())
    assert skipped > 0


def test_noise_without_shot_noise_survives_a_blown_pixel():
    """All samples saturated: the background is full scale; with b = 0 no warning, no NaN where a figure is due."""
    frames = np.full((4, 3, 3), 100, np.uint8) + np.arange(4, dtype=np.uint8)[:, None, None] * 20
    frames[:, 0, 0] = 255
    m = accumulated(frames, 255)
    assert m.background[0, 0] == 255
    out, lost = np.empty_like(m.phase), np.empty(m.phase.shape, np.uint8)
    noise = NoiseModel(1.0, 0.0)
    kernels.phase_sigma(m.phase, m.background, m.modulation, m.clipped, 4, noise.a, noise.b, 2, out, lost)
    assert math.isinf(out[0, 0])
    assert lost[0, 0] == 4
