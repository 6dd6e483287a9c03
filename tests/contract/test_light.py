"""What every light must do, simulated, replayed or real."""

from __future__ import annotations

import numpy as np
import pytest

from fringescope import capture
from fringescope.devices.base import Station
from fringescope.errors import DeviceError, RejectedError
from fringescope.settings import CaptureSettings


def test_it_keeps_the_level_that_it_is_set_to(station: Station) -> None:
    assert station.light is not None
    for level in (1.0, 0.0):
        station.light.set(level)
        assert station.light.level == pytest.approx(level, abs=0.01)


@pytest.mark.parametrize("level", [-0.1, 1.1, float("nan")])
def test_a_level_outside_is_refused(station: Station, level: float) -> None:
    assert station.light is not None
    with pytest.raises(RejectedError, match="0 to 1"):
        station.light.set(level)


def test_the_ring_light_picture_is_bright_and_the_light_is_off_afterwards(station: Station) -> None:
    assert station.light is not None
    photos = capture.photograph(
        station.projector, station.cameras, station.light, None, CaptureSettings(timeout_s=20.0)
    )
    assert len(photos) == len(station.cameras)
    for photo, camera in zip(photos, station.cameras, strict=True):
        assert photo.shape == (camera.info.height, camera.info.width)
        assert np.median(photo) > 0.1 * camera.settings.pixel_format.max_value
    assert station.light.level == 0.0


def test_closed_twice_is_closed_and_of_no_more_use(station: Station) -> None:
    assert station.light is not None
    station.light.close()
    station.light.close()
    with pytest.raises(DeviceError, match="closed"):
        station.light.set(0.5)
