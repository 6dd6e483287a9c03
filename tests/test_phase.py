"""Frames to absolute phase: captures drawn from formulas, as people make them, must give back the coordinates drawn."""

import numpy as np
import pytest
from scipy.stats import chi2

from fringescope import geometry, phase
from fringescope.errors import CaptureError, DecodeError
from fringescope.phase import noise
from fringescope.settings import PhaseSettings
from fringescope.types import FrameKey, FringeSet, GraySet, NoiseModel, PixelFormat, Reason, Rig, Role, Volume
from tests import core_scenes as core
from tests import fuse_scenes as scenes
from tests.reference.fringes import wrapped

S = PhaseSettings()
TWO_PI = 2 * np.pi
NOISE = (30.0, 0.4)  # 12 bits


def decode(plan, frames, rig=None, s=S, noise=None):
    return phase.settle_order(phase.measure(frames, plan, s, noise), plan, s, rig)


def capture(*sets, rng=None, plane=(400, 300), pixel_format=PixelFormat.MONO12, A=1600.0, B=1000.0, noise=NOISE,
            shape=(150, 200), **kw):
    """(plan, frames, u, v) of the drawn surface."""
    plan = core.plan(*sets, pixel_format=pixel_format, plane=plane)
    u, v = core.image(plane, shape)
    return plan, core.draw(plan, u, v, A, B, noise, rng, **kw), u, v


def judge(decoded, u, v, good=1.0, sigmas=6.0, direction=0):
    """The phase of the drawn coordinates, within its own sigmas; wrong orders only where the reasons say so."""
    d = decoded.directions[direction]
    truth = TWO_PI * (d.g[0] * u + d.g[1] * v)
    sure = (decoded.reasons & Reason.ORDER_UNCERTAIN) == 0
    assert sure.mean() >= good
    error = d.phase - truth
    assert (np.abs(error[sure]) < np.pi).all(), "a wrong order that nobody reports"
    assert (np.abs(error[sure]) < sigmas * d.sigma[sure] + 1e-3).all()
    return error


# -------------------------------------------------------------------------------------------------------- the measuring


def test_frames_may_come_in_any_order(rng):
    plan, frames, *_ = capture(core.fringes(450), core.fringes(60), core.fringes(14, steps=7), rng=rng)
    one = decode(plan, frames)
    two = decode(plan, [frames[i] for i in rng.permutation(len(frames))])
    assert len(frames) == 15
    np.testing.assert_allclose(one.directions[0].phase, two.directions[0].phase, atol=1e-5)
    np.testing.assert_array_equal(one.reasons, two.reasons)


def test_bayer_sites_are_never_mixed(rng):
    """A red filter that passes a third of the light changes A and B, not the phase; a broken pixel stays alone."""
    sets = core.fringes(450), core.fringes(60), core.fringes(14, steps=8)
    plan, frames, u, v = capture(*sets, pixel_format=PixelFormat.BAYER_RG12)
    gain = np.ones(u.shape)
    gain[::2, ::2], gain[1::2, 1::2] = 0.3, 0.6
    tinted = [(k, np.rint(f * gain).astype(np.uint16)) for k, f in frames]
    decoded = decode(plan, tinted, noise=NoiseModel(*NOISE))
    judge(decoded, u, v)
    np.testing.assert_allclose(decoded.modulation, 1000 * gain, atol=2)
    np.testing.assert_allclose(decoded.background, 1600 * gain, atol=2)
    broken = [(k, f.copy()) for k, f in tinted]
    for _, f in broken:
        f[20, 31] = rng.integers(0, 4095)
    other = phase.measure(broken, plan, S, NoiseModel(*NOISE))
    for a, b in zip(other.sets, decoded.sets, strict=True):
        differ = np.argwhere(a.phase != b.phase)
        assert differ.tolist() == [[20, 31]]


def test_frames_that_do_not_fit_one_sinusoid_are_inconsistent(rng):
    plan, frames, *_ = capture(core.fringes(450), core.fringes(14, steps=6), rng=rng)
    moved = [(k, f.copy()) for k, f in frames]
    moved[-2][1][10:15, 10:20] = 3000  # something passed in one frame
    decoded = phase.measure(moved, plan, S, NoiseModel(*NOISE))
    bad = (decoded.reasons & Reason.INCONSISTENT) != 0
    assert bad[10:15, 10:20].mean() > 0.8
    bad[10:15, 10:20] = False
    assert not bad.any()


def test_brackets_are_merged_pixel_by_pixel(rng):
    """Long and short exposures: where the long one is blown the short one stands alone, elsewhere both count."""
    sets = [core.fringes(450), core.fringes(60), core.fringes(14, steps=8, exposure_us=1000),
            core.fringes(14, steps=8, exposure_us=250)]
    plan = core.plan(*sets)
    u, v = core.image(shape=(150, 200))
    bright = u > 200
    A, B = np.where(bright, 7000, 1500), np.where(bright, 2500, 900)
    frames = []
    for key, f in core.draw(plan, u, v, A, B, NOISE, rng):
        if key.set_index < 2:  # coarse sets at a short exposure throughout
            g = plan.sets[key.set_index]
            light = 0.25 * (A + B * np.cos(TWO_PI * g.cycles_per_pixel[0] * u - TWO_PI * key.number / g.steps))
            f = np.rint(light).astype(np.uint16)
        frames.append((key, f))
    noise = NoiseModel(*NOISE)
    decoded = decode(plan, frames, noise=noise)
    assert len(decoded.sets) == 3
    judge(decoded, u, v)
    fine = decoded.sets[-1]
    alone = [phase.measure([(FrameKey(0, k.role, k.number), f) for k, f in frames if k.set_index == n],
                           core.plan(sets[n]), S, noise).sets[0] for n in (2, 3)]
    assert np.isinf(alone[0].sigma[bright]).all()
    np.testing.assert_allclose(fine.phase[bright], alone[1].phase[bright], atol=1e-6)
    np.testing.assert_allclose(fine.sigma[bright], alone[1].sigma[bright], rtol=1e-6)
    assert (fine.saturated[bright] == 0).all()
    w = [1 / a.sigma[~bright].astype(float) ** 2 for a in alone]
    np.testing.assert_allclose(fine.sigma[~bright], 1 / np.sqrt(w[0] + w[1]), rtol=1e-4)
    mean = np.angle(sum(wi * np.exp(1j * a.phase[~bright]) for wi, a in zip(w, alone, strict=True)))
    np.testing.assert_allclose(wrapped(fine.phase[~bright] - mean), 0, atol=1e-4)
    spread = decoded.directions[0].phase - TWO_PI * u / 14
    assert np.std(spread[~bright] / fine.sigma[~bright]) == pytest.approx(1, abs=0.1)


def test_equal_sets_without_exposures_stay_apart(rng):
    plan, frames, *_ = capture(core.fringes(450), core.fringes(14), core.fringes(14), rng=rng)
    assert len(phase.measure(frames, plan, S).sets) == 3


def test_two_samples_and_a_lent_background_still_tell_the_order(rng):
    """A coarse four-step set with two blown samples borrows the background of the fine set (same exposure)."""
    plan, frames, u, v = capture(core.fringes(450), core.fringes(60, steps=8), core.fringes(14, steps=8),
                                 A=3200, B=1400, rng=rng)
    decoded = decode(plan, frames)
    few = decoded.sets[0].saturated == 2
    assert few.mean() > 0.1
    error = np.abs(wrapped(decoded.sets[0].phase - TWO_PI * u / 450))
    assert (error[few] < 6 * decoded.sets[0].sigma[few]).all()
    judge(decoded, u, v, good=0.9)


def test_a_lent_background_does_not_excuse_more_blown_samples_than_allowed(rng):
    """Six of eight are blown; another set could lend its background, but a phase of two neighbours is no phase."""
    plan, frames, *_ = capture(core.fringes(450, steps=16), core.fringes(14, steps=8), A=4750, B=1500, rng=rng)
    fine = phase.measure(frames, plan, S, NoiseModel(*NOISE)).sets[1]
    many = fine.saturated == 6
    assert many.mean() > 0.1
    assert np.isinf(fine.sigma[many]).all()


# ------------------------------------------------------------------------------------------------------- bad captures


def one_line(e, *words):
    text = str(e.value)
    assert "\n" not in text
    assert all(w in text for w in words), text


GRAY = GraySet("u", 25.0, 4, inverse=True, white=True, black=True)


def test_missing_doubled_and_other_sized_frames_are_refused():
    plan, frames, *_ = capture(core.fringes(450), core.fringes(14), GRAY)
    with pytest.raises(CaptureError) as e:
        decode(plan, frames[:5] + frames[6:])
    one_line(e, "4-step set got 3 frames", "missing [1]")
    with pytest.raises(CaptureError) as e:
        decode(plan, frames[:4] + frames[8:])
    one_line(e, "no frames came for set 2 of 3", "camera1")
    with pytest.raises(CaptureError) as e:
        decode(plan, [*frames, frames[3]])
    one_line(e, "frame 3 of a 4-step set came twice")
    with pytest.raises(CaptureError) as e:
        decode(plan, [(k, f[:-1] if n == 2 else f) for n, (k, f) in enumerate(frames)])
    one_line(e, "200 x 149", "200 x 150")
    with pytest.raises(CaptureError) as e:
        decode(plan, [(k, f[:-1] if k.set_index == 1 else f) for k, f in frames])
    one_line(e, "sets of different sizes", "200 x 149", "200 x 150")


@pytest.mark.parametrize("role", [Role.BIT, Role.INVERSE, Role.WHITE, Role.BLACK])
def test_missing_and_doubled_gray_frames_are_refused(role):
    plan, frames, *_ = capture(core.fringes(450), core.fringes(14), GRAY)
    at = next(n for n, (k, _) in enumerate(frames) if k.role is role)
    with pytest.raises(CaptureError) as e:
        decode(plan, frames[:at] + frames[at + 1 :])
    one_line(e, "Gray code", role.value)
    with pytest.raises(CaptureError) as e:
        decode(plan, [*frames, frames[at]])
    one_line(e, "Gray code", "twice")


def test_a_gray_code_of_another_size_is_refused():
    plan, frames, *_ = capture(core.fringes(450), core.fringes(14), GRAY)
    with pytest.raises(CaptureError) as e:
        decode(plan, [(k, f[:, :-1] if k.set_index == 2 else f) for k, f in frames])
    one_line(e, "199 x 150", "200 x 150")
    mixed = [(k, f[:, :-1] if k.role is Role.BLACK else f) for k, f in frames]
    with pytest.raises(CaptureError) as e:
        decode(plan, mixed)
    one_line(e, "199 x 150", "200 x 150")


@pytest.mark.parametrize("pixel_format", [PixelFormat.MONO8, PixelFormat.RGB8, PixelFormat.BAYER_RG8])
def test_frames_of_another_kind_than_the_pixel_format_are_refused(pixel_format):
    plan = core.plan(core.fringes(450), pixel_format=pixel_format)
    shape = (4, 6) if pixel_format is PixelFormat.RGB8 else (4, 6, 3)
    with pytest.raises(CaptureError) as e:
        phase.measure([(k, np.zeros(shape, np.uint8)) for k in plan.keys], plan, S)
    one_line(e, pixel_format.value)


def test_rgb_frames_add_their_channels(rng):
    """One blown channel spoils the pixel's sample, whatever the others say."""
    plan, frames, u, v = capture(core.fringes(450), core.fringes(60), core.fringes(14, steps=8), A=110, B=60,
                                 pixel_format=PixelFormat.RGB8, noise=(0.5, 0.02), rng=rng)
    colours = [(k, np.stack([f, f // 2, f // 4], -1).astype(np.uint8)) for k, f in frames]
    judge(decode(plan, colours), u, v)
    colours[-1][1][3, 3, 1] = 255
    m = phase.measure(colours, plan, S)
    assert m.sets[-1].saturated[3, 3] == 1
    assert m.sets[-1].saturated.sum() == 1


def test_a_wholly_blown_pixel_is_no_accident(rng):
    """No NaN and no warning, also for a sensor whose noise does not grow with light."""
    plan, frames, *_ = capture(core.fringes(450), core.fringes(14), rng=rng)
    for _, f in frames:
        f[5:9, 5:9] = 4095
    decoded = decode(plan, frames, noise=NoiseModel(900.0, 0.0))
    assert np.isinf(decoded.directions[0].sigma[5:9, 5:9]).all()
    assert (decoded.reasons[5:9, 5:9] != 0).all()


# ---------------------------------------------------------------------------------------------------------- the orders

SETS = {
    "hierarchical": [core.fringes(450), core.fringes(70), core.fringes(14, steps=8)],
    "one period": [core.fringes(450, steps=5)],
    "three steps": [core.fringes(450, steps=3), core.fringes(70, steps=3), core.fringes(14, steps=3)],
    "beat of two": [core.fringes(23, steps=8), core.fringes(24.4, steps=8)],
    "beat of three": [core.fringes(19, steps=4), core.fringes(20.7, steps=4), core.fringes(23.1, steps=4)],
    "shuffled": [core.fringes(14, steps=8), core.fringes(450), core.fringes(70)],
    "antiparallel coarse": [core.fringes(450, np.pi), core.fringes(70), core.fringes(14, np.pi, steps=8)],
    "vertical": [core.fringes(450, np.pi / 2), core.fringes(70, np.pi / 2), core.fringes(14, np.pi / 2, steps=8)],
    "tilted": [core.fringes(520, 0.6), core.fringes(70, 0.6), core.fringes(14, 0.6, steps=8)],
    "tilted, coarsest wraps": [core.fringes(300, 0.6), core.fringes(70, 0.6), core.fringes(17, 0.6, steps=8)],
    "tilted backwards": [core.fringes(520, -2.5), core.fringes(70, -2.5), core.fringes(14, -2.5, steps=8)],
}


@pytest.mark.parametrize("name", sorted(SETS))
@pytest.mark.parametrize("pixel_format", [PixelFormat.MONO8, PixelFormat.MONO16])
def test_sets_unwrap_without_a_rig(name, pixel_format, rng):
    """Every order over the whole field, from sets alone."""
    scale = pixel_format.max_value / 255
    plan, frames, u, v = capture(*SETS[name], pixel_format=pixel_format, A=110 * scale, B=75 * scale,
                                 noise=(0.5 * scale**2, 0.02 * scale), rng=rng)
    # the ends of a field that the coarsest period only just spans, or a beat that is only just resolved, may be unsure
    judge(decode(plan, frames), u, v, good=0.9 if "beat" in name or "wraps" in name else 0.995)


def test_table_one_tilted_is_read_without_a_rig(rng):
    """1140, 200, 36 units on the DLP4500's plane: tilted, the coarsest wraps; the odd ratios still tell every order."""
    sets = [core.fringes(p, 0.8, n) for p, n in ((1140, 4), (200, 4), (36, 8))]
    plan, frames, u, v = capture(*sets, plane=(912, 1140), shape=(228, 183), A=110, B=75, noise=(0.5, 0.02), rng=rng,
                                 pixel_format=PixelFormat.MONO8)
    assert np.ptp((u * np.cos(0.8) + v * np.sin(0.8)) / 1140) > 1.2
    judge(decode(plan, frames), u, v, good=0.97)


@pytest.mark.parametrize("ratios", ["odd", "integer"])
def test_the_rig_settles_what_the_sets_leave_open(ratios, rng):
    """A coarsest period that wraps three times: integer ratios repeat exactly, only the measuring volume can tell."""
    rig = scenes.rig(3, 120, 90)
    rig = Rig(rig.projector, rig.cameras, Volume(np.zeros(3), np.eye(3), np.array([22.0, 18, 4])))
    periods = (80.0, 40.0, 20.0) if ratios == "integer" else (80.0, 47.0, 17.0)
    for camera in rig.cameras:
        p = core.plane_points(camera, (0.05, 0.1, 1.0), 1.0)
        view, angle = core.view(rig, camera, p, periods, rng=rng)
        u, v, lit = core.seen(rig, p)
        along = (u * np.cos(angle) + v * np.sin(angle))[lit]
        assert np.ptp(along) > 1.9 * 80
        measured = phase.measure(view.frames, view.plan, S)
        decoded = phase.settle_order(measured, view.plan, S, rig)
        d = decoded.directions[0]
        sure = lit & (decoded.reasons == 0)
        assert sure.sum() > 0.97 * lit.sum()
        truth = TWO_PI * (d.g[0] * u + d.g[1] * v)
        assert (np.abs(d.phase - truth)[sure] < 6 * d.sigma[sure] + 1e-3).all()
        if ratios == "integer":
            with pytest.raises(DecodeError, match="repeat after 80 projector units"):
                phase.settle_order(measured, view.plan, S)


def test_sets_that_cannot_be_unwrapped_are_refused(rng):
    plan, frames, *_ = capture(core.fringes(100), core.fringes(20, steps=8), rng=rng)
    with pytest.raises(DecodeError) as e:
        decode(plan, frames)
    one_line(e, "camera1", "repeat after 100", "add a coarser period or a Gray code, or give a rig")


def test_a_rig_that_lacks_the_camera_is_refused(rng):
    plan, frames, *_ = capture(core.fringes(450), rng=rng)
    plan = core.plan(*plan.sets, camera="other")
    with pytest.raises(Exception, match="lacks camera 'other'"):
        decode(plan, frames, scenes.rig(1))


def test_two_directions_give_both_coordinates(rng):
    sets = [core.fringes(p, a, n) for a in (0.3, 1.7) for p, n in ((560, 4), (80, 4), (16, 8))]
    plan, frames, u, v = capture(*sets, rng=rng)
    decoded = decode(plan, frames)
    assert len(decoded.directions) == 2
    for n in (0, 1):
        judge(decoded, u, v, direction=n)
    got = phase.projector_coordinates(decoded)
    np.testing.assert_allclose(got[0], u, atol=0.25)
    np.testing.assert_allclose(got[1], v, atol=0.25)


def test_one_direction_gives_its_own_coordinate(rng):
    plan, frames, _, v = capture(*SETS["vertical"], rng=rng)
    got = phase.projector_coordinates(decode(plan, frames))
    assert np.isnan(got[0]).all()
    np.testing.assert_allclose(got[1], v, atol=0.15)


def test_one_tilted_direction_gives_neither_coordinate(rng):
    plan, frames, *_ = capture(*SETS["tilted"], rng=rng)
    assert all(np.isnan(c).all() for c in phase.projector_coordinates(decode(plan, frames)))


# ------------------------------------------------------------------------------------------------------------ Gray code


@pytest.mark.parametrize("extras", ["inverse", "white and black", "none"])
@pytest.mark.parametrize("axis", ["u", "v"])
def test_gray_code_settles_the_order(axis, extras, rng):
    """Cells of half a period; the code's edges lie up to one unit beside the fringes', as real optics have it."""
    gray = GraySet(axis, 8.0, 6, inverse=extras == "inverse", white=extras == "white and black",
                   black=extras == "white and black")
    plan, frames, u, v = capture(core.fringes(16, 0 if axis == "u" else np.pi / 2, 4), gray, rng=rng,
                                 gray_shift=rng.uniform(-1, 1, (150, 200)))
    # without anything to compare with, the first word (all bits dark) cannot be told from shadow
    judge(decode(plan, frames), u, v, good=0.95 if extras == "none" else 0.99)


def test_off_by_one_at_the_edges_of_cells_as_wide_as_a_period_is_repaired(rng):
    """There the code alone is wrong by a whole order; the neighbours repair it."""
    gray = GraySet("u", 16.0, 5, inverse=True)
    plan, frames, u, v = capture(core.fringes(16, steps=4), gray, rng=rng, gray_shift=rng.uniform(-1, 1, (150, 200)))
    raw = decode(plan, frames, s=PhaseSettings(order_votes=1))
    wrong = np.abs(raw.directions[0].phase - TWO_PI * u / 16) > np.pi
    assert wrong.sum() > 20
    assert (raw.reasons[wrong] & Reason.ORDER_UNCERTAIN != 0).all()
    voted = decode(plan, frames)
    judge(voted, u, v, good=0.4)  # the code leaves half of each cell within three sigmas of the next order
    assert (np.abs(voted.directions[0].phase - TWO_PI * u / 16) < np.pi).mean() > 0.995


def test_gray_code_alone_is_a_coarse_direction(rng):
    plan, frames, u, _ = capture(GraySet("u", 25.0, 4, white=True, black=True), rng=rng)
    decoded = decode(plan, frames)
    got = phase.projector_coordinates(decoded)[0]
    sure = decoded.reasons == 0
    assert sure.mean() > 0.99
    assert (np.abs(got - u)[sure] <= 12.5 + 1e-3).all()


def test_dim_gray_bits_are_uncertain(rng):
    plan, frames, *_ = capture(core.fringes(16), GraySet("u", 8.0, 6, inverse=True), rng=rng)
    dim = [(k, np.full_like(f, 1600) if k.set_index == 1 and k.number == 3 else f) for k, f in frames]
    for k, f in dim:
        if k.set_index == 1 and k.number == 3:
            f[:, 20:] = dict(frames)[k][:, 20:]
    decoded = phase.measure(dim, plan, S)
    assert (decoded.gray[0].value[:, :20] == -1).all()
    assert (decoded.gray[0].value[:, 20:] >= 0).mean() > 0.99


# ---------------------------------------------------------------------------------------------------------- the votes


def speckled(rng, step=0.0):
    """A hierarchical capture whose middle set is spoilt in single pixels, so that their orders are wrong."""
    sets = core.fringes(450), core.fringes(60), core.fringes(14, steps=8)
    plan = core.plan(*sets)
    u, v = core.image(shape=(100, 200))
    u = np.minimum(u + np.where(np.arange(200) >= 100, step, 0), 396)
    frames = core.draw(plan, u, v, 1600, 1000, NOISE, rng)
    bad = rng.random(u.shape) < 0.03
    off = rng.uniform(0.15, 0.85, u.shape) * TWO_PI
    for k, f in frames:
        if k.set_index == 1:
            period = sets[k.set_index].period
            shifted = 1600 + 1000 * np.cos(TWO_PI * u / period + off - TWO_PI * k.number / 4)
            f[bad] = np.rint(shifted)[bad]
    return plan, frames, u, bad


def test_votes_repair_single_wrong_orders(rng):
    plan, frames, u, bad = speckled(rng)
    truth = TWO_PI * u / 14
    before = decode(plan, frames, s=PhaseSettings(order_votes=1)).directions[0].phase
    after = decode(plan, frames)
    inner = np.zeros(u.shape, bool)
    inner[3:-3, 3:-3] = True
    was_wrong = inner & (np.abs(before - truth) > np.pi)
    assert was_wrong.sum() > 60
    error = np.abs(after.directions[0].phase - truth)
    assert (error[was_wrong] < 0.3).mean() > 0.95
    assert (error[inner & ~bad] < 0.3).all()
    told = (after.reasons & Reason.ORDER_UNCERTAIN) != 0
    assert (told | (error < np.pi))[inner].mean() > 0.999
    # a vote moves by whole turns and by nothing else
    moved = (after.directions[0].phase - before)[np.isfinite(before)]
    np.testing.assert_allclose(wrapped(moved), 0, atol=1e-3)


@pytest.mark.parametrize("step", [5.0, 14.0, 23.0, -30.0])
def test_votes_do_not_smooth_a_true_step(step, rng):
    """A step of a third of a period to more than two, one of exactly a period among them: every pixel stays."""
    sets = core.fringes(450), core.fringes(60), core.fringes(14, steps=8)
    plan = core.plan(*sets)
    u, v = core.image(shape=(100, 200))
    u = 40 + 0.4 * u + np.where(np.arange(200) >= 100, step, 0)
    decoded = decode(plan, core.draw(plan, u, v, 1600, 1000, NOISE, rng))
    error = np.abs(decoded.directions[0].phase - TWO_PI * u / 14)
    assert (error < 6 * decoded.directions[0].sigma + 1e-3).all()


# ---------------------------------------------------------------------------------------------------- bounds and spans


def test_unambiguous_span_by_hand():
    def sets(*periods):
        return [FringeSet((1 / p, 0.0), 4) for p in periods]

    assert phase.unambiguous_span(sets(120, 40, 20), 0.2) == pytest.approx(120)
    assert phase.unambiguous_span(sets(90, 60), 0.2) == pytest.approx(180)
    assert phase.unambiguous_span(sets(100, 70), 0.2) == pytest.approx(700)
    assert phase.unambiguous_span(sets(50), 0.2) == pytest.approx(50)


def test_bounds_hold_every_phase_in_the_volume(rng):
    """Points all over the volume, seen by the camera: none lies outside the bounds of its pixel."""
    rig = scenes.rig(3, 60, 40)
    rig = Rig(rig.projector, rig.cameras, Volume(np.array([1.0, -2, 3]), np.eye(3), np.array([15.0, 10, 6])))
    for camera in rig.cameras:
        g = core.fringes(16, core.best_angle(rig, camera)).cycles_per_pixel
        bounds = geometry.phase_bounds(rig, camera, g, 1.0)
        p = rig.volume.center + rng.uniform(-1, 1, (4000, 3)) * rig.volume.half_size
        uv = geometry.project(camera, p)
        inside = (uv > 0).all(-1) & (uv[:, 0] < 59) & (uv[:, 1] < 39)
        p, uv = p[inside], uv[inside]
        assert len(p) > 1000
        h, w = bounds.shape[1:]
        i, j = uv[:, 1] / 39 * (h - 1), uv[:, 0] / 59 * (w - 1)
        corners = [bounds[:, a.astype(int), b.astype(int)]
                   for a in (np.floor(i), np.ceil(i)) for b in (np.floor(j), np.ceil(j))]
        phi = geometry.phase_at(rig.projector, g, p)
        assert (phi > np.min([c[0] for c in corners], 0)).all()
        assert (phi < np.max([c[1] for c in corners], 0)).all()
        assert np.ptp(phi) > 0.5 * (bounds[1].max() - bounds[0].min())  # and they are no wider than need be


@pytest.mark.parametrize("dof", [1, 2, 5, 13, 61])
def test_truncated_chi_squared_as_scipy_has_it(dof):
    few, most = (float(chi2.ppf(q, dof)) for q in (0.8, 0.998))
    want = chi2.cdf(few, dof + 2) / 0.8, most / dof, chi2.cdf(most, dof + 2) / 0.998
    np.testing.assert_allclose(noise._truncation(dof), want, rtol=1e-10)


@pytest.mark.parametrize(("least", "most"), [(89.0, 91.0), (40.0, 200.0)])
def test_few_pixels_tell_the_noise(least, most):
    """10,000 pixels suffice, from dark to bright; where all are alike, no slope is made up that leads astray."""
    sets = [core.fringes(p, 0.0, n) for p, n in ((270.0, 4), (60.0, 4), (16.0, 8))]
    plan = core.plan(*sets, pixel_format=PixelFormat.MONO8, plane=(400, 300))
    a, b = 0.5, 0.02
    v, u = np.mgrid[:96, :104] * 3.0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        A = rng.uniform(least, most, u.shape)
        found = phase.measure(core.draw(plan, u, v, A, 0.25 * A, (a, b), rng), plan, S).noise
        for level in (least, most):
            assert found.variance(level) == pytest.approx(a + 1 / 12 + b * level, rel=0.07)
        assert 0.3 < found.variance(1.0) < a + 1 / 12 + 1.1 * b * most
