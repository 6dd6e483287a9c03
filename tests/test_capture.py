"""Frame n is pattern n, or the capture says which is not."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from fringescope import capture, patterns, store
from fringescope.devices import registry, simulated
from fringescope.devices.base import CameraSettings, Exposure, Roi
from fringescope.errors import (
    CaptureError,
    DeviceError,
    DeviceLostError,
    IncompleteShotError,
    RejectedError,
    UsageError,
)
from fringescope.settings import CaptureSettings
from fringescope.twin import presets, scene
from fringescope.types import FrameKey, FringeSet, Lens, PatternPlan, PixelFormat, Projector, Rig, Role, ViewPlan

SMALL = "sim://pair/plane?scale=0.03&seed=1"
QUICK = CaptureSettings(timeout_s=0.3, retries=0)


def station(faults: simulated.Faults | None = None, preset: str = "pair") -> simulated.SimulatedStation:
    """An instrument with few pixels, and a projector of a quarter as many mirrors each way."""
    full = presets.instrument(preset, 0.03)
    p = full.rig.projector
    K = np.array(p.lens.K)
    K[:2] /= 4
    coarse = Projector(228, 285, p.layout, Lens(456, 285, K, p.lens.distortion), p.pose)
    inst = dataclasses.replace(full, rig=Rig(coarse, full.rig.cameras, full.rig.volume))
    return simulated.station(simulated.World(scene.make("plane", 1), inst, 1, faults=faults), SMALL)


def plan_of(s: simulated.SimulatedStation) -> PatternPlan:
    sets = (FringeSet((0.0, 1 / 300), 4), FringeSet((0.0, 1 / 30), 5))
    p, formats = s.rig.projector, s.world.instrument.pixel_formats
    views = [ViewPlan(c.name, f, sets, p.plane_size) for c, f in zip(s.rig.cameras, formats, strict=True)]
    return PatternPlan(p.width, p.height, p.layout, tuple(views))


def images_of(plan: PatternPlan, s: simulated.SimulatedStation) -> list[list[tuple[FrameKey, np.ndarray]]]:
    return [list(patterns.images(v, s.rig.projector)) for v in plan.views]


def collect(s: simulated.SimulatedStation, settings: CaptureSettings = QUICK):
    plan = plan_of(s)
    return capture.collect(s.projector, s.cameras, s.light, images_of(plan, s), plan, settings)


@pytest.mark.parametrize(
    ("preset", "cameras", "fmt"), [("pair", 2, PixelFormat.BAYER_RG8), ("single", 1, PixelFormat.MONO12)]
)
def test_every_frame_comes_under_its_key_and_follows_its_pattern(preset, cameras, fmt):
    with station(preset=preset) as s:
        plan = plan_of(s)
        images = images_of(plan, s)
        views = capture.collect(s.projector, s.cameras, s.light, images, plan, QUICK)
        assert len(views) == cameras
        for view, shown, name in zip(views, images, (c.name for c in s.rig.cameras), strict=True):
            assert view.plan.camera == name
            frames = dict(view.frames)
            assert tuple(frames) == view.plan.keys
            t = s.world.renderer.truth(name)
            ok = t.lit & (t.uv > 10).all(-1) & (t.uv < np.array([445, 274])).all(-1)
            v = np.rint(t.uv[ok]).astype(int)
            for key, image in shown[:4]:  # the coarsest set: brightness follows the mirror that lights the pixel
                mirror = image[v[:, 1], v[:, 0] // 2].astype(float)
                seen = frames[key][ok].astype(float)
                assert np.corrcoef(mirror, seen)[0, 1] > 0.8
            assert view.color is not None
            assert view.color.dtype == fmt.dtype
            assert np.median(view.color) > 0.1 * fmt.max_value
        assert s.light is not None
        assert s.light.level == 0.0


def test_frames_stream_while_they_arrive_and_the_noise_is_repeatable():
    with station() as s:
        plan = plan_of(s)
        images = images_of(plan, s)
        it = capture.stream(s.projector, s.cameras[0], images[0], plan.views[0], QUICK)
        first = next(it)
        assert first[0] == FrameKey(0, Role.STEP, 0)
        rest = list(it)
        assert len(rest) == len(plan.views[0].keys) - 1
    with station() as s:
        again = list(capture.stream(s.projector, s.cameras[0], images[0], plan.views[0], QUICK))
    assert all((a[1] == b[1]).all() for a, b in zip([first, *rest], again, strict=True))


@pytest.mark.parametrize(
    ("faults", "words"),
    [
        (simulated.Faults(drop={"camera2": frozenset({6})}), "camera2.*frame lost: set 2 step 2"),
        (simulated.Faults(drop={"camera2": frozenset({8})}), "camera2.*8 frames came.*9.*set 2 step 4"),
        (
            simulated.Faults(miss={"camera1": frozenset({5})}),
            r"camera1.*set 2 step 1.*\+1.00 periods.*trigger was missed",
        ),
        (simulated.Faults(late={"camera1": frozenset({7})}), r"camera1.*set 2 step 3.*\+0.50 periods.*late"),
        (simulated.Faults(corrupt={"camera1": frozenset({3})}), "camera1.*set 1 step 3 came incomplete"),
        (simulated.Faults(repeat=frozenset({6})), "camera1.*one of set 2 shows another pattern"),
        (simulated.Faults(repeat=frozenset({2})), "camera1.*one of set 1 shows another pattern"),
        (simulated.Faults(miss={"camera1": frozenset({0})}), "camera1.*one of set 1 shows another"),
    ],
)
def test_each_fault_is_found_and_named(faults, words):
    with station(faults) as s, pytest.raises(IncompleteShotError, match=words):
        collect(s)


def test_a_lost_camera_is_not_taken_for_a_lost_frame():
    with station(simulated.Faults(lost={"camera2": 5})) as s, pytest.raises(DeviceLostError, match="camera2"):
        collect(s)


def test_a_shot_that_failed_once_is_taken_again():
    with station() as s:
        plan = plan_of(s)
        images = images_of(plan, s)
        s.world.faults = simulated.Faults(drop={"camera1": frozenset({2})})
        real, calls = s.projector.load, []

        def load(shot):
            if calls:
                s.world.faults = simulated.Faults()
            calls.append(shot)
            return real(shot)

        s.projector.load = load  # type: ignore[method-assign]
        views = capture.collect(s.projector, s.cameras, None, images, plan, CaptureSettings(timeout_s=0.3, retries=1))
    assert len(calls) == 3
    assert [len(list(v.frames)) for v in views] == [9, 9]
    assert views[0].color is None


def test_devices_are_free_again_after_a_failure():
    with station(simulated.Faults(drop={"camera1": frozenset({2})})) as s:
        with pytest.raises(IncompleteShotError):
            collect(s)
        s.world.faults = simulated.Faults()
        assert len(collect(s)) == 2


def test_images_that_are_not_the_plans_are_refused():
    with station() as s:
        plan = plan_of(s)
        images = images_of(plan, s)
        with pytest.raises(CaptureError, match="8 images"):
            capture.collect(s.projector, s.cameras, s.light, [images[0][:-1], images[1]], plan, QUICK)
        with pytest.raises(CaptureError, match="2 views"):
            capture.collect(s.projector, s.cameras[:1], s.light, images, plan, QUICK)
        with pytest.raises(CaptureError, match="in order"):
            capture.collect(s.projector, s.cameras, s.light, [images[0][::-1], images[1]], plan, QUICK)


def test_timing_leaves_a_rolling_shutter_its_readout():
    with station() as s:
        t = capture.timing(s.projector, s.cameras, CaptureSettings(exposure_us=16000, margin_us=200))
        assert t == Exposure(16000, 16200 + s.cameras[0].info.readout_us)
        camera = s.cameras[0]
        h = camera.info.height // 4
        camera.configure(CameraSettings(PixelFormat.BAYER_RG8, 1000, roi=Roi(0, 0, camera.info.width, h)))
        assert camera.info.readout_of(camera.settings.roi) < camera.info.readout_us
        with pytest.raises(RejectedError, match="exposure_us higher"):
            capture.timing(s.projector, s.cameras, CaptureSettings(exposure_us=100))


@pytest.mark.parametrize("noise", [0.5, 3.0])
def test_noise_and_gamma_are_no_wrong_frames_but_a_swap_is(noise):
    rng = np.random.default_rng(0)
    phase = np.linspace(0, 40, 4000)[None, :, None] + np.array([0.0, 0.05])
    n = np.arange(8)[:, None, None]
    pure = 0.5 + 0.5 * np.cos(phase - 2 * np.pi * n / 8)

    def ratio(x: np.ndarray) -> float:
        samples = np.rint(np.clip(20 + 100 * x + rng.normal(0, noise, x.shape), 0, 250))
        modulation, energy = capture.wrong_frames(samples, 255.0)
        alone = energy.max() > 2 * np.median(energy)
        return float(np.sqrt(energy.max()) / modulation) if alone else 0.0

    assert ratio(pure) < 0.02
    assert ratio(pure**1.8) < 0.1
    for order in ([0, 1, 2, 4, 3, 5, 6, 7], [0, 1, 2, 2, 4, 5, 6, 7], [7, 1, 2, 3, 4, 5, 6, 0]):
        assert ratio(pure[order]) > 0.12


def test_the_dark_proves_nothing_and_fails_nothing():
    assert capture.wrong_frames(np.full((8, 500, 2), 2, np.uint8), 255.0)[0] == 0.0


# ------------------------------------------------------------------------------------------------------ URIs and replay


def test_a_replayed_capture_gives_the_same_frames(tmp_path: Path):
    with station() as s:
        plan = plan_of(s)
        images = images_of(plan, s)
        views = capture.collect(s.projector, s.cameras, s.light, images, plan, QUICK)
        store.write_capture(tmp_path / "c", 228, 285, plan.layout, views)
    with registry.open_station((tmp_path / "c").as_uri()) as r:
        again = capture.collect(r.projector, r.cameras, r.light, images, plan, QUICK)
    for a, b in zip(views, again, strict=True):
        assert all((x[1] == y[1]).all() and x[0] == y[0] for x, y in zip(a.frames, b.frames, strict=True))
        assert (a.color == b.color).all()


def test_devices_are_listed_and_opened_by_uri():
    listed = registry.find(SMALL)
    assert [x.kind for x in listed] == ["projector", "camera", "camera", "light"]
    for x in listed:
        with registry.open_device(x.uri) as d:
            assert d.info.uri == x.uri  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("uri", "error", "words"),
    [
        ("usb://x/y#camera1", UsageError, "unknown kind"),
        ("sim://paper/plane?scale=0.03", UsageError, "names no device"),
        ("sim://paper/plane?scale=0.03#camera9", DeviceError, "camera1, camera2, camera3"),
        ("sim://paper/cube?scale=0.03#camera1", UsageError, "cube"),
        ("sim://large/plane#camera1", UsageError, "large"),
        ("sim://paper/plane?scale=big#camera1", UsageError, "number"),
        ("sim://paper/plane?colour=red#camera1", UsageError, "unknown option"),
        ("sim://paper#camera1", UsageError, "for example"),
    ],
)
def test_uris_that_name_nothing_are_refused(uri, error, words):
    with pytest.raises(error, match=words):
        registry.open_device(uri)
