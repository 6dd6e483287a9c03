"""What every projector must do, simulated, replayed or real."""

from __future__ import annotations

import numpy as np
import pytest

from fringescope.devices.base import Exposure, Leds, PatternRef, Shot, Station
from fringescope.errors import DeviceError, RejectedError


def test_info_says_what_it_is(station: Station) -> None:
    i = station.projector.info
    assert i.uri.endswith("#projector")
    assert i.width > 0
    assert i.height > 0
    assert i.max_patterns >= 1


def test_every_pattern_has_its_edge_one_period_apart(station: Station, shot: Shot) -> None:
    loaded = station.projector.load(shot)
    with station.projector.fire(loaded) as running:
        running.wait(20)
        edges = np.array(running.edges)
    assert len(edges) == len(shot.patterns)
    assert np.abs(np.diff(edges) - 1000 * loaded.exposure.period_us).max() < 250 * loaded.exposure.period_us


def test_a_shot_can_be_fired_again(station: Station, shot: Shot) -> None:
    loaded = station.projector.load(shot)
    for _ in range(2):
        with station.projector.fire(loaded) as running:
            running.wait(20)
            assert len(running.edges) == len(shot.patterns)


def test_another_shot_replaces_the_one_before(station: Station, shot: Shot) -> None:
    old = station.projector.load(shot)
    station.projector.load(shot)
    with pytest.raises(RejectedError, match="load it again"):
        station.projector.fire(old)


def test_pictures_of_another_size_or_type_are_refused(station: Station, shot: Shot) -> None:
    i = station.projector.info
    for bad in (
        np.zeros((i.width, i.height), np.uint8),
        np.zeros((i.height, i.width - 1), np.uint8),
        np.zeros((i.height, i.width), np.uint16),
        np.zeros((i.height, i.width, 3), np.uint8),
    ):
        with pytest.raises(RejectedError, match="pattern 0"):
            station.projector.load(Shot((PatternRef(bad),), shot.exposure))


def test_cancel_twice_and_after_the_end(station: Station, shot: Shot) -> None:
    running = station.projector.fire(station.projector.load(shot))
    running.cancel()
    running.cancel()
    running.wait(20)


def test_closed_twice_is_closed_and_of_no_more_use(station: Station, shot: Shot) -> None:
    station.projector.close()
    station.projector.close()
    with pytest.raises(DeviceError, match="closed"):
        station.projector.load(shot)


@pytest.mark.parametrize(("duration", "period"), [(0, 100), (200, 100), (1000, 1100), (-5, -5)])
def test_impossible_timing_is_refused(duration: int, period: int) -> None:
    with pytest.raises(RejectedError, match="period"):
        Exposure(duration, period)


def test_possible_timing_is_taken() -> None:
    assert Exposure(16667, 16667).period_us == 16667
    assert Exposure(1000, 1230).duration_us == 1000


def test_an_empty_shot_and_too_bright_a_lamp_are_refused() -> None:
    with pytest.raises(RejectedError, match="at least one"):
        Shot((), Exposure(10000, 10000))
    with pytest.raises(RejectedError, match="green"):
        Leds(green=1.2)
