"""Each mask on small drawn scenes: it must take what is bad, keep what is good, and say why."""

import cv2
import numpy as np
import pytest

from fringescope import denoise, phase
from fringescope.settings import DenoiseSettings, PhaseSettings
from fringescope.types import Decoded, Direction, Grid, NoiseModel, PixelFormat, Reason, Rig, Volume
from tests import core_scenes as core
from tests import fuse_scenes as scenes

S = DenoiseSettings()
TWO_PI = 2 * np.pi


def decode(A, B, rng, noise=(0.5, 0.02), shape=(80, 120), s=S):
    """A drawn 8-bit capture, decoded, and its reasons after the first mask."""
    plan = core.plan(core.fringes(450), core.fringes(60), core.fringes(16, steps=8), pixel_format=PixelFormat.MONO8)
    u, v = core.image(shape=shape)
    frames = core.draw(plan, u, v, A, B, noise, rng)
    measured = phase.measure(frames, plan, PhaseSettings(), NoiseModel(*noise))
    decoded = phase.settle_order(measured, plan, PhaseSettings())
    return decoded, denoise.exposed(decoded, PixelFormat.MONO8, s)


def share(reasons, reason, where):
    return ((reasons[where] & reason) != 0).mean()


def sheet(p, sigma, rng=None, camera="camera1", g=(1 / 16, 0.0)):
    """A view with one direction whose absolute phase is p plus noise."""
    p = np.asarray(p, float)
    sigma = np.broadcast_to(sigma, p.shape).astype(np.float32)
    if rng is not None:
        p = p + sigma * rng.normal(size=p.shape)
    zero = np.zeros(p.shape, np.float32)
    d = Direction(g, p.astype(np.float32), sigma.copy(), zero + 99)
    return Decoded(camera, (d,), (), (), zero + 100, zero + 70, np.zeros(p.shape, np.uint16), NoiseModel(0.5, 0.02))


# ---------------------------------------------------------------------------------------- 1: background and modulation


def test_dark_saturated_and_flat_pixels_are_named(rng):
    A, B = np.full((80, 120), 110.0), np.full((80, 120), 70.0)
    A[:, :20], B[:, :20] = 0.8, 0.5  # shadow
    A[:, 40:60], B[:, 40:60] = 600, 400  # a highlight
    B[:, 80:100] = 1.0  # light that is not the fringes'
    _, reasons = decode(A, B, rng)
    assert share(reasons, Reason.DARK, np.s_[:, :20]) > 0.99
    assert share(reasons, Reason.SATURATED, np.s_[:, 41:59]) > 0.95
    assert share(reasons, Reason.LOW_MODULATION, np.s_[:, 80:100]) > 0.99
    for good in (np.s_[:, 20:40], np.s_[:, 60:80], np.s_[:, 100:]):
        assert (reasons[good] == 0).mean() > 0.995
    assert share(reasons, Reason.DARK | Reason.SATURATED, np.s_[:, 80:100]) == 0
    assert share(reasons, Reason.ORDER_UNCERTAIN, np.s_[:, :20]) == 0  # one word: dark, not dark and uncertain


def test_the_modulation_threshold_follows_the_brightness(rng):
    """The same five codes of modulation are good in dark tissue and drown in the noise of bright tissue."""
    A, B = np.full((80, 120), 20.0), np.full((80, 120), 5.0)
    A[:, 60:] = 180.0
    _, reasons = decode(A, B, rng, noise=(0.1, 0.012), s=DenoiseSettings(min_contrast=0.0, max_sigma_factor=50.0))
    assert (reasons[:, :60] == 0).mean() > 0.95
    assert share(reasons, Reason.LOW_MODULATION, np.s_[:, 60:]) > 0.6
    _, reasons = decode(A, B, rng, noise=(0.1, 0.012))
    assert (reasons[:, :60] == 0).mean() > 0.95
    assert share(reasons, Reason.LOW_MODULATION, np.s_[:, 60:]) > 0.99  # 5 of 180 is also too small a share


def test_lost_fine_contrast_is_low_modulation(rng):
    """Light that came from elsewhere keeps the coarse fringes and loses the fine ones."""
    plan = core.plan(core.fringes(450), core.fringes(60), core.fringes(16, steps=8), pixel_format=PixelFormat.MONO8)
    u, v = core.image(shape=(80, 120))
    frames = core.draw(plan, u, v, 110, 70, (0.5, 0.02), rng)
    weak = core.draw(plan, u, v, 110, 30, (0.5, 0.02), rng)
    spot = np.s_[30:40, 50:62]
    for (k, f), (_, w) in zip(frames, weak, strict=True):
        if k.set_index == 2:
            f[spot] = w[spot]
    s = PhaseSettings()
    decoded = phase.settle_order(phase.measure(frames, plan, s), plan, s)
    reasons = denoise.exposed(decoded, PixelFormat.MONO8, S)
    assert share(reasons, Reason.LOW_MODULATION, spot) > 0.95
    reasons[spot] = 0
    assert (reasons != 0).mean() < 0.005


def test_thresholds_scale_with_the_bit_depth(rng):
    """The same light on 8 and on 16 bits loses the same pixels."""
    A = np.linspace(1, 120, 120)[None, :] + np.zeros((60, 1))
    lost = []
    for fmt in (PixelFormat.MONO8, PixelFormat.MONO16):
        scale = fmt.max_value / 255
        plan = core.plan(core.fringes(450), core.fringes(60), core.fringes(16, steps=8), pixel_format=fmt)
        noise = NoiseModel(0.3 * scale**2, 0.01 * scale)
        u, v = core.image(shape=(60, 120))
        frames = core.draw(plan, u, v, A * scale, 0.6 * A * scale, (noise.a, noise.b), rng)
        s = PhaseSettings()
        decoded = phase.settle_order(phase.measure(frames, plan, s, noise), plan, s)
        lost.append((denoise.exposed(decoded, fmt, S) & (Reason.DARK | Reason.LOW_MODULATION) != 0).mean())
    assert 0.01 < lost[0] < 0.5
    assert lost[0] == pytest.approx(lost[1], abs=0.02)


# ------------------------------------------------------------------------------------------------- 2: mirrored fringes


@pytest.fixture(scope="module")
def plate():
    """A plate in a rig of three cameras: (rig, camera, phase of its own direction, gradient), camera by camera."""
    rig = scenes.rig(3, 120, 90)
    rig = Rig(rig.projector, rig.cameras, Volume(np.zeros(3), np.eye(3), np.array([25.0, 20, 8])))
    out = []
    for camera in rig.cameras:
        g = core.fringes(16, core.best_angle(rig, camera)).cycles_per_pixel
        u, v, _ = core.seen(rig, core.plane_points(camera, (0.05, 0.1, 1.0), 1.0))
        out.append((rig, camera, TWO_PI * (g[0] * u + g[1] * v), g))
    return out


def test_fringes_that_run_backwards_are_found_in_every_view(plate, rng):
    spot = np.s_[30:52, 50:75]
    for rig, camera, p, g in plate:
        mirrored = p.copy()
        mirrored[spot] = 2 * p[41, 62] - p[spot]  # the phase about its middle, running the other way
        decoded = sheet(mirrored, 0.03, rng, camera.name, g)
        reasons = denoise.monotonic(decoded, decoded.reasons, rig, S)
        assert set(np.unique(reasons)) == {0, int(Reason.REVERSED)}
        assert share(reasons, Reason.REVERSED, np.s_[33:49, 53:72]) > 0.98
        reasons[27:55, 47:78] = 0
        assert (reasons == 0).all(), camera.name


def test_a_plain_surface_has_no_reversed_fringes(plate, rng):
    """Neither steep slopes, nor noise on a phase that hardly grows, nor single bad pixels."""
    for rig, camera, p, g in plate:
        y, x = np.mgrid[:90, :120]
        hill = p + 3 * np.exp(-((x - 60) ** 2 + (y - 45) ** 2) / 400)
        noisy = sheet(hill, 0.6, rng, camera.name, g)
        assert (denoise.monotonic(noisy, noisy.reasons, rig, S) != 0).mean() < 1e-3
        flat = sheet(np.zeros_like(p), 0.05, rng, camera.name, g)
        assert (denoise.monotonic(flat, flat.reasons, rig, S) != 0).mean() < 1e-3
        wrong = hill + np.where(rng.random(p.shape) < 0.02, rng.choice([-3.0, 3.0], p.shape), 0)
        spoilt = sheet(wrong, 0.03, rng, camera.name, g)
        assert (denoise.monotonic(spoilt, spoilt.reasons, rig, S) != 0).mean() < 5e-3


# ------------------------------------------------------------------------------------------------ 3: jumps and domains


def test_small_domains_go_and_large_ones_stay(rng):
    """T2: an island below the limit goes, one above it stays, and neither takes its surroundings along."""
    y, x = np.mgrid[:60, :80]
    p = 0.3 * x + 0.05 * y
    small, large = np.s_[10:16, 10:16], np.s_[30:45, 40:60]
    p[small] += 12
    p[large] += 12
    s = DenoiseSettings(island_share=50 / p.size)
    decoded = sheet(p, 0.02, rng)
    reasons = denoise.connected(decoded, decoded.reasons, None, s)
    assert (reasons[small] != 0).all()
    assert share(reasons, Reason.ISLAND, np.s_[11:15, 11:15]) == 1
    assert (reasons[32:43, 42:58] == 0).all()
    rest = np.ones(p.shape, bool)
    rest[9:17, 9:17] = rest[29:46, 39:61] = False
    rest[[0, 0, -1, -1], [0, -1, 0, -1]] = False  # three neighbours are too few to tell, in the image's corners
    assert (reasons[rest] == 0).all()
    kept = denoise.connected(decoded, decoded.reasons, None, DenoiseSettings(island_share=5 / p.size))
    assert (kept[11:15, 11:15] == 0).all()


def test_pixels_on_a_jump_go_and_steep_ground_stays(plate, rng):
    """T1 follows what the rig predicts: single pixels off the surface are jumps, a slope of twice the usual is not."""
    rig, camera, p, g = plate[0]
    steep = p[45, 60] + 2 * (p - p[45, 60])
    decoded = sheet(steep, 0.03, rng, camera.name, g)
    assert (denoise.connected(decoded, decoded.reasons, rig, S)[2:-2, 2:-2] == 0).all()
    crumbs = p.copy()
    spots = [(20, 30), (40, 80), (60, 50), (70, 100)]
    for i, j in spots:
        crumbs[i, j] += 15
    decoded = sheet(crumbs, 0.03, rng, camera.name, g)
    reasons = denoise.connected(decoded, decoded.reasons, rig, S)
    for i, j in spots:
        assert reasons[i, j] & Reason.JUMP
        reasons[i, j] = 0
    reasons[[0, 0, -1, -1], [0, -1, 0, -1]] = 0
    assert (reasons == 0).all()


# ------------------------------------------------------------------------------------------------ 4: the local surface


SURFACES = {
    "plane": lambda x, y: 0.4 * x + 0.1 * y,
    "sphere": lambda x, y: 0.4 * x + 8 * np.sqrt(np.maximum(1 - ((x - 60) ** 2 + (y - 45) ** 2) / 150**2, 0)),
    "saddle": lambda x, y: 0.4 * x + 0.004 * (x - 60) * (y - 45),
    "waves": lambda x, y: 0.4 * x + 1.5 * np.sin(TWO_PI * x / 40) * np.cos(TWO_PI * y / 45),
}


@pytest.mark.parametrize("name", sorted(SURFACES))
@pytest.mark.parametrize("sigma", [0.02, 0.1])
def test_noise_on_a_curved_surface_is_no_reason_to_go(name, sigma, rng):
    y, x = np.mgrid[:90, :120].astype(float)
    decoded = sheet(SURFACES[name](x, y), sigma, rng)
    reasons = denoise.local(decoded, decoded.reasons, None, S)
    assert (reasons != 0).mean() < 0.005


@pytest.mark.parametrize("name", sorted(SURFACES))
def test_single_bad_points_go(name, rng):
    """Off by ten sigmas and more: gone. Their neighbours stay."""
    y, x = np.mgrid[:90, :120].astype(float)
    sigma = 0.03
    p = SURFACES[name](x, y)
    bad = np.zeros(p.shape, bool)
    bad[4:-4:9, 4:-4:11] = True
    p = p + np.where(bad, rng.choice([-1.0, 1.0], p.shape) * rng.uniform(10, 25, p.shape) * sigma, 0)
    decoded = sheet(p, sigma, rng)
    reasons = denoise.local(decoded, decoded.reasons, None, S)
    assert share(reasons, Reason.NOT_LOCAL, bad) > 0.97
    assert share(reasons, Reason.NOT_LOCAL, ~bad) < 0.01


def test_masks_only_take_away(plate, rng):
    """Reasons that were there stay there, and no phase is moved."""
    rig, camera, p, g = plate[1]
    decoded = sheet(p, 0.03, rng, camera.name, g)
    before = (rng.random(p.shape) < 0.1).astype(np.uint16) * np.uint16(Reason.DARK)
    held = before.copy()
    kept = decoded.directions[0].phase.copy()
    for mask in (denoise.monotonic(decoded, before, rig, S), denoise.connected(decoded, before, rig, S),
                 denoise.local(decoded, before, rig, S)):
        assert ((mask & before) == before).all()
        assert mask is not before
    np.testing.assert_array_equal(before, held)
    np.testing.assert_array_equal(decoded.directions[0].phase, kept)


# ----------------------------------------------------------------------------------------------- the views' agreement


def grids(rig, hit, rng, sigma=0.01):
    return [scenes.grid(rig, n, hit, sigma, rng) for n in range(len(rig.cameras))]


def test_views_that_see_the_same_surface_contradict_nothing(rng):
    """A ball over a floor: each view sees places that are hidden in the others, and keeps them."""
    rig = scenes.rig(3, 160, 120)
    views = grids(rig, scenes.ball(), rng)
    out = denoise.agree(views, rig, S)
    for before, after in zip(views, out, strict=True):
        lost = before.valid & ~after.valid
        assert lost.sum() <= 3e-4 * before.valid.sum()
        np.testing.assert_array_equal(after.xyz[after.valid], before.xyz[after.valid])


def test_points_hidden_in_another_view_stay(rng):
    """Floor that view 1 sees and the ball hides from view 2 (by the line of sight): no evidence against it."""
    rig = scenes.rig(2, 160, 120)
    views = grids(rig, scenes.ball(), rng)
    out = denoise.agree(views, rig, S)
    pose = rig.cameras[1].pose
    o, middle, radius = -pose.R.T @ pose.t, np.array([0, 0, 4.0]), 6.0
    p = views[0].xyz.astype(float)
    d = (p - o) / np.linalg.norm(p - o, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        hidden = (np.linalg.norm(np.cross(middle - o, d), axis=-1) < radius - 0.3) & (p[..., 2] < -1.9)
    assert hidden.sum() > 50
    assert (out[0].reasons[hidden] == 0).all()


def test_flying_points_in_front_of_another_view_s_surface_go(rng):
    """3 mm in front of a plate: the other views look through it and deny it; 3 mm behind: hidden there, no evidence."""
    rig = scenes.rig(3, 160, 120)
    views = grids(rig, scenes.plane(), rng)
    o = -rig.cameras[0].pose.R.T @ rig.cameras[0].pose.t
    spots = [(i, j) for i in range(40, 90, 10) for j in range(50, 120, 15)]
    for shift, denied in ((-3.0, True), (3.0, False)):
        xyz = views[0].xyz.copy()
        for i, j in spots:
            d = (xyz[i, j] - o) / np.linalg.norm(xyz[i, j] - o)
            xyz[i, j] += shift * d
        first = Grid(0, views[0].camera, xyz, views[0].sigma, views[0].reasons)
        out = denoise.agree([first, *views[1:]], rig, S)
        for i, j in spots:
            assert out[0].reasons[i, j] == (Reason.VIEWS_DISAGREE if denied else 0)
            assert np.isnan(out[0].xyz[i, j]).all() == denied
            assert np.isnan(out[0].sigma[i, j]) == denied
        changed = (out[0].reasons != first.reasons).sum()
        assert changed == (len(spots) if denied else 0)
        np.testing.assert_array_equal(out[1].reasons, views[1].reasons)
        assert (first.reasons == views[0].reasons).all()


def test_a_single_view_has_nobody_to_ask(rng):
    rig = scenes.rig(1, 60, 40)
    (view,) = grids(rig, scenes.plane(), rng)
    (out,) = denoise.agree([view], rig, S)
    np.testing.assert_array_equal(out.reasons, view.reasons)


# --------------------------------------------------------------------------------------------------------- the verdict


def lossy(**shares):
    """A view of 100 x 100 pixels with given shares of reasons, one after the other."""
    reasons = np.zeros(10000, np.uint16)
    at = 0
    for name, part in shares.items():
        n = round(10000 * part)
        reasons[at : at + n] = Reason[name]
        at += n
    reasons = reasons.reshape(100, 100)
    return Grid(1, "camera2", np.zeros((100, 100, 3), np.float32), np.zeros((100, 100), np.float32), reasons)


@pytest.mark.parametrize(("reason", "part", "advice"), [
    ("SATURATED", 0.06, "halve the exposure"), ("REVERSED", 0.02, "dry the surface"),
    ("VIEWS_DISAGREE", 0.05, "calibrate anew"), ("OUT_OF_VOLUME", 0.2, "measuring volume"),
    ("ORDER_UNCERTAIN", 0.1, "orders left open"), ("INCONSISTENT", 0.05, "out of order"),
    ("LOW_MODULATION", 0.9, "expose longer"),
])  # fmt: skip
def test_the_verdict_names_the_camera_the_share_and_what_to_do(reason, part, advice):
    v = denoise.verdict(lossy(**{reason: part}))
    assert (v.camera, v.pixels, v.points) == ("camera2", 10000, round(10000 * (1 - part)))
    assert v.lost[reason.lower()] == round(10000 * part)
    (told,) = [w for w in v.words if Reason[reason].label in w]
    assert told.startswith("camera2: ")
    assert f"{100 * part:.1f} %" in told
    assert advice in told
    assert "\n" not in told


def test_the_verdict_is_quiet_about_what_is_usual():
    v = denoise.verdict(lossy(DARK=0.5, SATURATED=0.001, JUMP=0.01, NOT_LOCAL=0.01))
    assert v.words == ("camera2: 4790 points on 5000 pixels with fringes of 10000",)


def test_shares_are_of_the_lit_pixels_and_say_so():
    v = denoise.verdict(lossy(DARK=0.5, SATURATED=0.03))
    assert any("6.0 % of the pixels with fringes: saturated; " in w for w in v.words)


@pytest.mark.parametrize(("reason", "part", "told"), [("DARK", 0.98, "98.0"), ("LOW_MODULATION", 0.9, "90.0")])
def test_shares_of_pixels_without_fringes_are_of_all_and_say_so(reason, part, told):
    v = denoise.verdict(lossy(**{reason: part}, JUMP=0.01))
    (weak,) = [w for w in v.words if Reason[reason].label in w]
    assert weak.startswith(f"camera2: {told} % of all pixels: {Reason[reason].label}; ")
    (jump,) = [w for w in v.words if Reason.JUMP.label in w]
    share = 100 * 0.01 / (1 - part)
    assert jump.startswith(f"camera2: {share:.1f} % of the pixels with fringes: phase jump; ")


def test_what_to_do_about_open_orders_is_true_for_every_set():
    """Gray codes and heterodyne sets leave orders open too, where no coarse fringe is too noisy."""
    (told,) = [w for w in denoise.verdict(lossy(ORDER_UNCERTAIN=0.1)).words if "order uncertain" in w]
    assert "noisy" not in told
    assert "phase.systematic_rad" in told
    assert hasattr(PhaseSettings(), "systematic_rad")


def test_the_verdict_of_a_black_view():
    v = denoise.verdict(lossy(DARK=1.0))
    assert v.points == 0
    assert any("no point was left" in w for w in v.words)
    assert any("lens cap" in w for w in v.words)


# ----------------------------------------------------------------------------------------------- interpolated pixels


def rgb_frames(change, gamma=1.0, full=255):
    """An RGB capture whose sensor samples go through `change`, decoded."""
    rng = np.random.default_rng(3)
    plan = core.plan(core.fringes(450), core.fringes(60), core.fringes(16, steps=8), pixel_format=PixelFormat.RGB8)
    u, v = core.image(shape=(120, 160))
    frames = []
    for key, ideal in core.draw(plan, u, v, 110.0, 70.0, (0.0, 0.0), np.random.default_rng(0)):
        mean = np.asarray(ideal, float).reshape(*ideal.shape[:2], -1)[..., 0]
        mean = full * (mean / 255) ** gamma
        noisy = mean[..., None] + rng.normal(0, 2.0, (*mean.shape, 3))
        frames.append((key, change(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))))
    return phase.measure(frames, plan, PhaseSettings())


def demosaiced(rgb, code):
    raw = rgb[..., 1].copy()
    raw[0::2, 0::2], raw[1::2, 1::2] = rgb[0::2, 0::2, 0], rgb[1::2, 1::2, 2]
    return cv2.cvtColor(raw, code)


@pytest.mark.parametrize("gamma", [1.0, 1.3])
def test_rgb_of_three_samples_a_pixel_is_no_interpolation(gamma):
    assert not denoise.interpolated(rgb_frames(lambda a: a, gamma), PixelFormat.RGB8)


@pytest.mark.parametrize(
    "change",
    [
        lambda a: demosaiced(a, cv2.COLOR_BayerRG2RGB),
        lambda a: demosaiced(a, cv2.COLOR_BayerRG2RGB_EA),
        lambda a: demosaiced(a, cv2.COLOR_BayerRG2RGB_VNG),
        lambda a: cv2.GaussianBlur(a, (3, 3), 0.7),
        lambda a: cv2.resize(a[::2, ::2], (160, 120), interpolation=cv2.INTER_LINEAR),
    ],
    ids=["bilinear", "edges", "vng", "blurred", "scaled"],
)
@pytest.mark.parametrize("gamma", [1.0, 1.3])
def test_interpolated_pixels_are_told(change, gamma):
    decoded = rgb_frames(change, gamma)
    assert denoise.interpolated(decoded, PixelFormat.RGB8)
    assert not denoise.interpolated(decoded, PixelFormat.MONO8)
    grid = lossy()
    assert "interpolated" in denoise.verdict(grid, True).words[-1]
    assert not any("interpolated" in w for w in denoise.verdict(grid).words)
