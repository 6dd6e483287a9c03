"""The fused kernel against the stages, which are tested against outside truth: equal to float32, for any usual plan."""

from dataclasses import replace

import numpy as np
import pytest

from fringescope import denoise, geometry, phase, pipeline, triangulate
from fringescope.errors import CaptureError, DecodeError
from fringescope.pipeline import fast
from fringescope.settings import PhaseSettings, Settings
from fringescope.types import PixelFormat, Pose, Reason, Rig, ViewInput, Volume
from tests import core_scenes as core
from tests import fuse_scenes as scenes
from tests.reference import rays

S = Settings()


def rig_of(width=157, height=83, volume=True):
    """Odd sizes, so that no block or segment fits."""
    r = scenes.rig(3, width, height)
    return Rig(r.projector, r.cameras, Volume(np.zeros(3), np.eye(3), np.array([24.0, 20, 6])) if volume else None)


def bowl(camera):
    """Where the rays of a camera meet a gently curved surface: (H, W, 3)."""
    o, d = rays.camera_rays(camera)
    t = (1.0 - o[2]) / d[..., 2]
    for _ in range(6):
        p = o + t[..., None] * d
        t = (2.0 * np.cos(p[..., 0] / 9) * np.cos(p[..., 1] / 7) - o[2]) / d[..., 2]
    return o + t[..., None] * d


def view_of(rig, camera, pixel_format, periods=(270.0, 60.0, 16.0), steps=(4, 4, 8), flip=(), order=None, A=0.4, B=0.25,
            seed=3, noise=None):  # fmt: skip
    """Frames of the bowl: brightness falls to nothing at the left; `flip`: sets whose gradient points the other way."""
    angle = core.best_angle(rig, camera)
    turned = [angle + (np.pi if i in flip else 0) for i in range(len(periods))]
    sets = [core.fringes(p, a, n) for p, a, n in zip(periods, turned, steps, strict=True)]
    sets = [sets[i] for i in (order or range(len(sets)))]
    plan = core.plan(*sets, pixel_format=pixel_format, plane=rig.projector.plane_size, camera=camera.name)
    u, v, lit = core.seen(rig, bowl(camera))
    top = pixel_format.max_value
    fall = np.clip(np.linspace(0.0, 2.0, u.shape[1]), 0, 1)[None, :]
    scale = top / 255
    noise = noise or (0.5 * scale**2, 0.02 * scale)
    rng = np.random.default_rng(seed)
    return ViewInput(plan, core.draw(plan, u, v, A * top * fall, B * top * fall, noise=noise, rng=rng, lit=lit))


def by_stages(view, rig, s=S):
    d = phase.measure(view.frames, view.plan, s.phase, view.noise)
    d = phase.settle_order(d, view.plan, s.phase, rig, s.denoise.volume_margin)
    r = denoise.exposed(d, view.plan.pixel_format, s.denoise)
    return d, triangulate.grid(d, r, rig, volume_margin=s.denoise.volume_margin, rim=s.denoise.rim)


def compare(view, rig, s=S, apart=0.0):
    """Fused and staged agree: the same pixels (but for a share `apart`), points to 0.2 um, the rest to float32."""
    fused = fast.decode(view, rig, s)
    assert fused is not None
    got, xyz, sigma_mm, _ = fused
    d, g = by_stages(view, rig, s)
    good, want = got.reasons == 0, g.reasons == 0
    assert (good != want).mean() <= apart
    both = good & want
    assert both.mean() > 0.2
    # float32 at the largest absolute phase, ~100 rad, and 25 mm from the origin; the depth table adds less than 0.1 um
    np.testing.assert_allclose(got.directions[0].phase[both], d.directions[0].phase[both], atol=5e-5)
    np.testing.assert_allclose(xyz[both], g.xyz[both], atol=2e-4)
    np.testing.assert_allclose(got.directions[0].sigma[both], d.directions[0].sigma[both], rtol=2e-5)
    np.testing.assert_allclose(sigma_mm[both], g.sigma[both], rtol=5e-5)
    top = view.plan.pixel_format.max_value
    np.testing.assert_allclose(got.background, d.background, atol=2e-6 * top)
    np.testing.assert_allclose(got.modulation, d.modulation, atol=4e-6 * top)
    weak = ((got.reasons | g.reasons) & (Reason.DARK | Reason.LOW_MODULATION)) != 0
    for reason in Reason:  # what a view lost, and why, does not depend on the way; orders of dark pixels mean nothing
        counted = ~weak if reason in (Reason.ORDER_UNCERTAIN, Reason.OUT_OF_VOLUME) else np.ones_like(weak)
        lost, expected = (int((counted & ((r & reason) != 0)).sum()) for r in (got.reasons, g.reasons))
        assert abs(lost - expected) <= max(apart, 0.002) * good.size, reason
    return got.reasons, g.reasons


@pytest.mark.parametrize("fmt", list(PixelFormat)[:-1])
def test_every_pixel_format(fmt):
    rig = rig_of()
    compare(view_of(rig, rig.cameras[1], fmt), rig, apart=0.001)


PLANS = [((270.0, 60.0, 16.0), (3, 3, 3)), ((270.0, 60.0, 16.0), (5, 4, 7)), ((270.0, 40.0), (4, 12)),
         ((40.0, 37.0), (6, 6)), ((270.0, 90.0, 40.0, 16.0), (4, 3, 5, 16)), ((250.0,), (8,))]  # fmt: skip


@pytest.mark.parametrize(("periods", "steps"), PLANS)
def test_every_plan(periods, steps):
    rig = rig_of()
    compare(view_of(rig, rig.cameras[2], PixelFormat.MONO12, periods, steps), rig, apart=0.002)


def test_any_order_of_sets_and_frames_and_either_sign():
    rig = rig_of()
    view = view_of(rig, rig.cameras[0], PixelFormat.MONO8, flip=(0, 1), order=(2, 0, 1))
    frames = list(view.frames)
    np.random.default_rng(0).shuffle(frames)
    compare(replace(view, frames=frames), rig, apart=0.001)


@pytest.mark.parametrize("shape", [(157, 83), (520, 40), (64, 9), (33, 4)])
def test_any_size(shape):
    rig = rig_of(*shape)
    compare(view_of(rig, rig.cameras[1], PixelFormat.MONO8), rig, apart=0.01)


def test_without_a_volume():
    rig = rig_of(volume=False)
    compare(view_of(rig, rig.cameras[1], PixelFormat.MONO8), rig, apart=0.001)


def test_saturated_samples_take_the_scalar_way():
    rig = rig_of()
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8, A=0.8, B=0.4)
    clipped = np.mean([(f == 255).mean() for _, f in view.frames])
    assert clipped > 0.1
    got, want = compare(view, rig, apart=0.002)
    for bit in (Reason.SATURATED, Reason.DARK, Reason.LOW_MODULATION):
        assert abs(int(((got & bit) != 0).sum()) - int(((want & bit) != 0).sum())) < 0.002 * got.size


@pytest.mark.parametrize("flip", [(0,), (1,), (2,), (0, 1), (0, 1, 2)])
def test_saturated_samples_of_sets_that_point_the_other_way(flip):
    rig = rig_of()
    compare(view_of(rig, rig.cameras[1], PixelFormat.MONO8, flip=flip, A=0.8, B=0.4), rig, apart=0.002)


def test_a_wrong_frame_shows_beside_saturated_samples():
    rig = rig_of()
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8, A=0.8, B=0.4)
    frames = [(k, f.copy()) for k, f in view.frames]
    wrong = frames[10][1]
    wrong[:, 60:120] = np.maximum(wrong[:, 60:120].astype(int) - 60, 0)
    view = replace(view, frames=frames)
    got, (_, want) = fast.decode(view, rig, S).decoded, by_stages(view, rig)
    torn, expected = ((r & Reason.INCONSISTENT) != 0 for r in (got.reasons, want.reasons))
    clipped = np.any([f == 255 for _, f in frames], axis=0)
    assert (expected & clipped).sum() > 500
    assert (torn != expected).mean() < 0.003
    assert ((got.reasons == 0) != (want.reasons == 0)).mean() < 0.003


def test_sets_of_different_exposure_go_the_stages_way():
    rig = rig_of()
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8)
    sets = tuple(replace(one, exposure_us=e) for one, e in zip(view.plan.sets, (4000, 4000, 1000), strict=True))
    assert fast.decode(replace(view, plan=replace(view.plan, sets=sets)), rig, S) is None
    same = tuple(replace(one, exposure_us=4000) for one in view.plan.sets)
    assert fast.decode(replace(view, plan=replace(view.plan, sets=same)), rig, S) is not None


def test_frames_of_any_memory_layout():
    rig = rig_of()
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8)
    want = fast.decode(view, rig, S)
    odd = []
    for key, f in view.frames:
        wide = np.zeros((2 * f.shape[0], 3 * f.shape[1]), f.dtype)
        wide[::2, ::3] = f
        odd.append((key, wide[::2, ::3]))
    got = fast.decode(replace(view, frames=odd), rig, S)
    np.testing.assert_array_equal(got[1], want[1])
    np.testing.assert_array_equal(got[0].reasons, want[0].reasons)


def packed(frame):
    """GenICam 12p by its definition: a stream of bits, lowest first, in octets filled from their low end."""
    bits = (frame[..., None] >> np.arange(12, dtype=np.uint16)) & 1
    octets = np.packbits(bits.astype(np.uint8).reshape(frame.shape[0], -1), axis=1, bitorder="little")
    return octets.reshape(frame.shape[0], frame.shape[1] // 2, 3)


@pytest.mark.parametrize("pixel_format", [PixelFormat.MONO12, PixelFormat.BAYER_RG12])
@pytest.mark.parametrize("rows_apart", [False, True])
def test_packed_frames_are_read_as_they_come(pixel_format, rows_apart):
    rig = rig_of(1166, 23)  # more than two blocks of pixels
    view = view_of(rig, rig.cameras[0], pixel_format, A=0.6, B=0.5)  # some saturated
    frames = [(key, packed(f)) for key, f in view.frames]
    if rows_apart:
        frames = [(key, np.repeat(f, 2, axis=0)[::2]) for key, f in frames]
    color = view.frames[0][1]
    whole, grid = pipeline.scan_view(view, rig, S)
    got, same = pipeline.scan_view(replace(view, frames=frames), rig, S)
    assert grid.valid.any()
    np.testing.assert_array_equal(same.xyz, grid.xyz)
    np.testing.assert_array_equal(same.reasons, grid.reasons)
    np.testing.assert_array_equal(got.background, whole.background)
    staged = [pipeline.decode_view(replace(view, frames=f), S).directions[0].phase for f in (view.frames, frames)]
    np.testing.assert_array_equal(*staged)
    photos = [pipeline.picture(replace(view, color=c), whole, S).rgb for c in (color, packed(color))]
    np.testing.assert_array_equal(*photos)


def test_packed_frames_of_other_formats_are_refused():
    rig = rig_of(158, 83)
    view = view_of(rig, rig.cameras[0], PixelFormat.MONO16)
    wrong = [(key, packed(f >> 4)) for key, f in view.frames]
    with pytest.raises(CaptureError, match=r"83, 79, 3\); Mono16 needs \(H, W\)"):
        pipeline.scan_view(replace(view, frames=wrong), rig, S)


def test_noise_alone_gives_no_point():
    rig = rig_of()
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8, A=0.0, B=0.0, noise=(4.0, 0.0))
    _, grid = pipeline.scan_view(view, rig, S)
    assert not grid.valid.any()
    assert np.isnan(grid.xyz).all()


def test_wrong_orders_are_repaired_and_their_points_with_them():
    """A coarse set so noisy that its orders fail here and there: the neighbours' vote moves the points as well."""
    rig = rig_of()
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8, (270.0, 16.0), (3, 8), B=0.03, A=0.5)
    s = replace(S, phase=PhaseSettings(order_min_margin=1.5), denoise=replace(S.denoise, max_sigma_rad=1.0))
    got, xyz, sigma_mm, _ = fast.decode(view, rig, s)
    alone, *_ = fast.decode(view, rig, replace(s, phase=replace(s.phase, order_votes=1)))
    moved = np.abs(got.directions[0].phase - alone.directions[0].phase) > 1
    assert moved.sum() > 20
    _, g = by_stages(view, rig, s)
    both = (got.reasons == 0) & (g.reasons == 0)
    assert ((got.reasons == 0) != (g.reasons == 0)).mean() < 0.01
    assert (moved & both).sum() > 10
    np.testing.assert_allclose(xyz[both], g.xyz[both], atol=3e-4)
    np.testing.assert_allclose(sigma_mm[both], g.sigma[both], rtol=1e-3)


def test_what_the_kernel_does_not_take_goes_the_stages_way():
    rig = rig_of()
    c = rig.cameras[1]
    view = view_of(rig, c, PixelFormat.MONO8)
    plan = view.plan
    across = core.fringes(40.0, 0.3, 4)
    two = core.plan(*plan.sets, across, pixel_format=PixelFormat.MONO8, plane=plan.projector_size, camera=c.name)
    u, v, lit = core.seen(rig, bowl(c))
    assert fast.decode(ViewInput(two, core.draw(two, u, v, lit=lit)), rig, S) is None
    bracket = core.plan(*plan.sets, plan.sets[2], pixel_format=PixelFormat.MONO8, plane=plan.projector_size,
                        camera=c.name)  # fmt: skip
    assert fast.decode(ViewInput(bracket, core.draw(bracket, u, v, lit=lit)), rig, S) is None
    with pytest.raises(CaptureError, match="missing"):
        pipeline.scan_view(replace(view, frames=view.frames[:-1]), rig, S)
    key, last = view.frames[-1]
    with pytest.raises(CaptureError, match="pixels"):
        pipeline.scan_view(replace(view, frames=[*view.frames[:-1], (key, last[1:])]), rig, S)
    fine = core.plan(plan.sets[2], pixel_format=PixelFormat.MONO8, plane=plan.projector_size, camera=c.name)
    deep = Rig(rig.projector, rig.cameras, Volume(np.zeros(3), np.eye(3), np.array([24.0, 20, 120])))
    with pytest.raises(DecodeError, match="repeat"):
        pipeline.scan_view(ViewInput(fine, core.draw(fine, u, v, lit=lit)), deep, S)


# ----------------------------------------------------------------------------------------------------- the depth table


def test_depth_table_is_the_exact_solution():
    """At random pixels and depths of random rigs: 0.1 um, by a projection that is OpenCV's."""
    rng = np.random.default_rng(4)
    for _ in range(6):
        r = rig_of(volume=bool(rng.integers(2)))
        turned = [Pose(c.pose.R, c.pose.t + rng.normal(0, 4, 3)) for c in r.cameras]
        r = Rig(r.projector, tuple(replace(c, pose=p) for c, p in zip(r.cameras, turned, strict=True)), r.volume)
        c = r.cameras[0]
        a = core.best_angle(r, c) + rng.uniform(-0.5, 0.5)
        g = (float(np.cos(a) / 16), float(np.sin(a) / 16))
        table = geometry.depth_table(r, c, g, 1.25)
        uv = rng.uniform(0, 1, (500, 2)) * [c.lens.width - 1, c.lens.height - 1]
        n = geometry.unproject(c.lens, uv)
        near, far = (table.depth - 8, table.depth + 8)
        z = rng.uniform(near, far, 500)
        p = (np.column_stack([n, np.ones(500)]) * z[:, None] - c.pose.t) @ c.pose.R
        turns = rays.projector_uv(r.projector, p) @ g
        got = geometry.points_by_table(table.cubics, table.step, table.depth, geometry.centre(c.pose), uv, turns)
        assert np.abs(got - p).max() < 1e-4
        assert table.error_mm < 1e-4
