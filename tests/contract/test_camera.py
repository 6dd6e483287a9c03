"""What every camera must do, simulated, replayed or real."""

from __future__ import annotations

import threading
import time
from itertools import pairwise

import numpy as np
import pytest

from fringescope.devices.base import CameraSettings, Roi, Shot, Station, Trigger, TriggerSource
from fringescope.errors import DeviceError, DeviceTimeoutError, RejectedError
from fringescope.types import PixelFormat


def test_info_says_what_it_is(station: Station) -> None:
    for camera in station.cameras:
        i = camera.info
        assert "#" in i.uri
        assert i.width > 0
        assert i.height > 0
        assert camera.settings.pixel_format in i.pixel_formats
        assert i.readout_of(None) > 0
        assert i.readout_of(Roi(0, 0, i.width, max(1, i.height // 2))) <= i.readout_of(None)


def test_armed_before_fire_it_gives_every_pattern_in_order(station: Station, shot: Shot) -> None:
    n = len(shot.patterns)
    loaded = station.projector.load(shot)
    armed = [c.arm(n, Trigger(timeout_s=20)) for c in station.cameras]
    with station.projector.fire(loaded) as running:
        for camera, acquisition in zip(station.cameras, armed, strict=True):
            with acquisition:
                frames = list(acquisition)
                assert acquisition.surplus(0.05) == 0
            assert len(frames) == n
            first = frames[0].block_id
            assert [f.block_id for f in frames] == list(range(first, first + n))
            for f in frames:
                assert f.complete
                assert f.pixel_format is camera.settings.pixel_format
                assert f.pixels.shape[:2] == (camera.info.height, camera.info.width)
                assert f.pixels.dtype == f.pixel_format.dtype
                assert f.pixels.max() <= f.pixel_format.max_value
            times = [f.device_ns for f in frames if f.device_ns is not None]
            if len(times) == n:
                gaps = np.diff(times)
                assert np.abs(gaps - loaded.exposure.period_us * 1000).max() < 250 * loaded.exposure.period_us
            assert all(b.host_ns >= a.host_ns for a, b in pairwise(frames))
        running.wait(20)


def test_frames_differ_as_their_patterns_do(station: Station, shot: Shot) -> None:
    camera = station.cameras[0]
    loaded = station.projector.load(shot)
    with camera.arm(3, Trigger(timeout_s=20)) as a, station.projector.fire(loaded):
        frames = [f.pixels.astype(float) for f in a]
    noise = np.abs(frames[0][:, 2:] - frames[0][:, :-2]).mean()
    assert np.abs(frames[0] - frames[1]).max() > 5 * max(noise, 1)


def test_more_frames_than_asked_for_are_counted(station: Station, shot: Shot) -> None:
    camera = station.cameras[0]
    loaded = station.projector.load(shot)
    with camera.arm(2, Trigger(timeout_s=20)) as a, station.projector.fire(loaded) as running:
        assert len(list(a)) == 2
        running.wait(20)
        assert a.surplus(0.2) == 1


def test_it_can_be_armed_again(station: Station, shot: Shot) -> None:
    camera = station.cameras[0]
    last = 0
    for _ in range(2):
        loaded = station.projector.load(shot)
        with camera.arm(3, Trigger(timeout_s=20)) as a, station.projector.fire(loaded):
            ids = [f.block_id for f in a]
        assert len(ids) == 3
        assert ids[0] != last
        last = ids[-1]


def test_no_edge_no_frame_and_a_typed_timeout(station: Station) -> None:
    with station.cameras[0].arm(1, Trigger(timeout_s=0.05)) as a, pytest.raises(DeviceTimeoutError, match="#"):
        list(a)


def test_cancel_from_another_thread_ends_the_wait(station: Station) -> None:
    with station.cameras[0].arm(1, Trigger(timeout_s=30)) as a:
        other = threading.Timer(0.1, a.cancel)
        other.start()
        begin = time.monotonic()
        assert list(a) == []
        assert time.monotonic() - begin < 10
        other.join()
        a.cancel()  # twice is once


def test_armed_twice_is_refused(station: Station) -> None:
    camera = station.cameras[0]
    with camera.arm(1, Trigger()), pytest.raises(RejectedError, match="armed"):
        camera.arm(1, Trigger())
    camera.arm(1, Trigger()).cancel()


@pytest.mark.parametrize("n", [0, -1])
def test_arming_for_nothing_is_refused(station: Station, n: int) -> None:
    with pytest.raises(RejectedError, match="at least 1"):
        station.cameras[0].arm(n, Trigger())


def test_a_software_trigger_needs_to_be_armed_for(station: Station) -> None:
    with station.cameras[0].arm(1, Trigger(TriggerSource.LINE)) as a, pytest.raises(RejectedError, match="software"):
        a.trigger()
    with station.cameras[0].arm(1, Trigger(TriggerSource.SOFTWARE, 20)) as a:
        a.trigger()
        assert len(list(a)) == 1


def test_settings_that_it_does_not_have_are_refused(station: Station) -> None:
    camera = station.cameras[0]
    i, now = camera.info, camera.settings
    other = next(f for f in PixelFormat if f not in i.pixel_formats)
    for bad in (
        CameraSettings(other, now.exposure_us),
        CameraSettings(now.pixel_format, 0),
        CameraSettings(now.pixel_format, now.exposure_us, gain=0.0),
        CameraSettings(now.pixel_format, now.exposure_us, gain=float("nan")),
        CameraSettings(now.pixel_format, now.exposure_us, roi=Roi(0, 0, i.width + 1, i.height)),
        CameraSettings(now.pixel_format, now.exposure_us, roi=Roi(-2, 0, 4, 4)),
        CameraSettings(now.pixel_format, now.exposure_us, roi=Roi(1, 0, 4, 4)),
    ):
        with pytest.raises(RejectedError):
            camera.configure(bad)
        assert camera.settings == now
    took = camera.configure(CameraSettings(now.pixel_format, now.exposure_us + 100))
    assert camera.settings == took


def test_closed_twice_is_closed_and_of_no_more_use(station: Station) -> None:
    camera = station.cameras[0]
    a = camera.arm(1, Trigger(timeout_s=30))
    camera.close()
    camera.close()
    assert camera.closed
    assert list(a) == []
    with pytest.raises(DeviceError, match="closed"):
        camera.arm(1, Trigger())
