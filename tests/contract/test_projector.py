"""What every projector must do, simulated, replayed or real."""

from __future__ import annotations

import dataclasses
import pickle
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from fringescope.devices.base import (
    Exposure,
    KillSwitch,
    Leds,
    PatternRef,
    ProjectorInfo,
    Shot,
    Station,
    Trigger,
    TriggerSource,
)
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


# ------------------------------------------------------------------------------------------------------ held pictures


def white(station: Station, *more: int) -> np.ndarray:
    i = station.projector.info
    return np.full((i.height, i.width, *more), 255, np.uint8)


def snapshot(station: Station, camera: int = 0) -> np.ndarray:
    """What a camera sees now; skipped where an instrument cannot photograph what it holds."""
    with station.cameras[camera].arm(1, Trigger(TriggerSource.SOFTWARE, 20)) as a:
        try:
            a.trigger()
        except RejectedError as e:
            assert "cannot photograph" in str(e)  # noqa: PT017
            pytest.skip(str(e))
        return next(iter(a)).pixels.astype(float)


def test_a_picture_is_held_until_it_is_made_dark(station: Station) -> None:
    p = station.projector
    assert p.shown is None
    picture = white(station)
    p.show(picture)
    picture[:] = 0  # the caller's own array; what is held stays
    assert p.shown is not None
    assert p.shown.min() == 255
    with pytest.raises(ValueError, match="read-only"):
        p.shown[0, 0] = 1
    p.dark()
    p.dark()
    assert p.shown is None


def test_another_picture_replaces_it_and_a_shot_ends_it(station: Station, shot: Shot) -> None:
    p = station.projector
    p.show(white(station))
    p.show(np.zeros_like(white(station)), Leds(0.5, 0.5, 0.5))
    assert p.shown is not None
    assert p.shown.max() == 0
    with p.fire(p.load(shot)) as running:
        assert p.shown is None
        running.wait(20)
    assert p.shown is None  # and does not come back


def test_colours_are_shown_or_refused(station: Station) -> None:
    p = station.projector
    if p.info.colours:
        p.show(white(station, 3))
        assert p.shown is not None
        assert p.shown.shape == (p.info.height, p.info.width, 3)
    else:
        with pytest.raises(RejectedError, match="grey"):
            p.show(white(station, 3))
        assert p.shown is None


def test_a_projector_without_colours_refuses_them(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    p = station.projector
    grey: ProjectorInfo = dataclasses.replace(p.info, colours=False)
    monkeypatch.setattr(type(p), "info", property(lambda _: grey))
    with pytest.raises(RejectedError, match="grey"):
        p.show(white(station, 3))
    p.show(white(station))


def test_no_other_picture_is_shown(station: Station) -> None:
    p = station.projector
    p.show(white(station))
    i = p.info
    for bad in (
        np.zeros((i.width, i.height), np.uint8),
        np.zeros((i.height, i.width), np.uint16),
        np.zeros((i.height, i.width), np.float64),
        np.zeros((i.height, i.width, 4), np.uint8),
        np.zeros((i.height, i.width, 1), np.uint8),
        np.zeros((0, 0), np.uint8),
        np.zeros((i.height, i.width), bool).tolist(),
        None,
    ):
        with pytest.raises(RejectedError, match="needed"):
            p.show(bad)
        assert p.shown is not None  # what was asked for before stays


def test_cameras_see_what_is_held_and_nothing_afterwards(station: Station) -> None:
    p = station.projector
    p.show(white(station))
    lit = snapshot(station)
    p.dark()
    dark = snapshot(station)
    noise = max(np.abs(dark[:, 2:] - dark[:, :-2]).mean(), 1)
    assert np.median(lit - dark) > 5 * noise
    p.show(white(station), Leds(0, 0, 0))
    assert np.abs(np.median(snapshot(station) - dark)) < 2 * noise


def test_dark_from_another_thread_ends_a_shot(station: Station, shot: Shot) -> None:
    p = station.projector
    many = Shot(shot.patterns * 200 if p.info.max_patterns >= 600 else shot.patterns, shot.exposure)
    running = p.fire(p.load(many))
    took: list[float] = []

    def dark() -> None:
        begin = time.monotonic()
        p.dark()
        took.append(time.monotonic() - begin)

    threads = [threading.Thread(target=dark) for _ in range(3)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    running.wait(20)  # it is over
    assert max(took) < 1.0
    assert p.shown is None


def test_closed_it_is_dark(station: Station) -> None:
    p = station.projector
    p.show(white(station))
    p.close()
    assert p.shown is None
    p.dark()
    with pytest.raises(DeviceError, match="closed"):
        p.show(white(station))
    with pytest.raises(DeviceError, match="closed"):
        p.kill_switch()


# ---------------------------------------------------------------------------------------------------- the kill switch


def elsewhere(switch: KillSwitch, folder: Path, why: str) -> subprocess.CompletedProcess[str]:
    """Cuts in a process of its own, which gets the switch alone."""
    code = "import pickle, sys; pickle.load(open(sys.argv[1], 'rb')).cut(sys.argv[2])"
    (folder / "switch").write_bytes(pickle.dumps(switch))
    command = [sys.executable, "-c", code, str(folder / "switch"), why]
    return subprocess.run(command, capture_output=True, text=True, check=True)


def test_a_cut_from_another_process_is_dark_until_it_is_released(station: Station, shot: Shot, tmp_path: Path) -> None:
    p = station.projector
    switch = p.kill_switch()
    assert p.cut is None
    assert switch.state is None
    p.show(white(station))
    elsewhere(switch, tmp_path, "somebody's hand was in the light")
    assert p.shown is None
    assert p.cut is not None
    assert switch.state == p.cut
    assert abs(time.monotonic_ns() - p.cut.at_ns) < 60e9
    loaded = p.load(shot)
    for verb in (lambda: p.show(white(station)), lambda: p.fire(loaded)):
        with pytest.raises(RejectedError, match=r"somebody's hand was in the light.*release"):
            verb()
    switch.cut("a second reason")
    assert p.cut.why == "somebody's hand was in the light"
    p.dark()
    assert p.cut is not None  # dark is no release
    p.release()
    assert p.cut is None
    assert p.shown is None  # what it held before does not come back
    p.show(white(station))
    assert p.shown is not None


def test_a_cut_before_the_first_picture_holds_too(station: Station) -> None:
    p = station.projector
    p.kill_switch().cut()
    with pytest.raises(RejectedError, match="kill switch"):
        p.show(white(station))
    p.release()
    p.show(white(station))


def test_who_asks_for_the_dark_keeps_new_pictures_away(station: Station) -> None:
    p = station.projector
    p.kill_switch().ask("STOP of the operator")
    with pytest.raises(RejectedError, match="STOP of the operator"):
        p.show(white(station))


def test_a_cut_is_seen_by_cameras(station: Station) -> None:
    p = station.projector
    dark = snapshot(station)
    p.show(white(station))
    snapshot(station)
    p.kill_switch().cut()
    noise = max(np.abs(dark[:, 2:] - dark[:, :-2]).mean(), 1)
    assert np.abs(np.median(snapshot(station) - dark)) < 2 * noise


def test_two_switches_of_one_projector_and_none_of_another(station: Station) -> None:
    p = station.projector
    a, b = p.kill_switch(), p.kill_switch()
    assert a == b
    a.cut("first")
    assert b.state is not None
    assert b.state.why == "first"


def test_a_switch_of_a_closed_projector_has_nothing_to_do(station: Station) -> None:
    late, early = station.projector.kill_switch(), station.projector.kill_switch()
    early.open()
    station.projector.close()
    early.cut("after the end")
    late.cut("after the end")
    assert early.state is not None
    assert early.state.why == "the projector was closed"
