"""Which instruments the contract is checked on: simulated and replayed always, real ones by an environment variable.

`FRINGESCOPE_CONTRACT_URIS` holds URIs of instruments, separated by commas, that these tests may drive: they play a few
dark and bright patterns and switch the light on and off.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fringescope import capture, store
from fringescope.devices import registry
from fringescope.devices.base import Exposure, PatternRef, Shot, Station
from fringescope.settings import CaptureSettings
from fringescope.types import FrameKey, FringeSet, PatternPlan, Role, ViewPlan

SIMULATED = "sim://pair/plane?scale=0.02&seed=3"


def stripes(station: Station, g: float, n: int, steps: int) -> np.ndarray:
    i = station.projector.info
    v = np.arange(i.height)[:, None] + np.zeros(i.width)
    return np.rint(127.5 + 127.5 * np.cos(2 * np.pi * g * v - 2 * np.pi * n / steps)).astype(np.uint8)


def small_plan(station: Station, steps: int = 5) -> tuple[PatternPlan, list[list[tuple[FrameKey, np.ndarray]]]]:
    """One set of fringes along v for every camera, and its images."""
    i = station.projector.info
    size = (2 * i.width if i.layout.value == "diamond" else i.width, i.height)
    views = tuple(
        ViewPlan(c.info.uri.split("#")[1], c.settings.pixel_format, (FringeSet((0.0, 1 / 80), steps),), size)
        for c in station.cameras
    )
    images = [[(FrameKey(0, Role.STEP, n), stripes(station, 1 / 80, n, steps)) for n in range(steps)] for _ in views]
    return PatternPlan(i.width, i.height, i.layout, views), images


@pytest.fixture(scope="session")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture of the simulated instrument, to be replayed."""
    folder = tmp_path_factory.mktemp("contract") / "capture"
    with registry.open_station(SIMULATED) as s:
        plan, images = small_plan(s)
        views = capture.collect(s.projector, s.cameras, s.light, images, plan, CaptureSettings(timeout_s=20.0))
    store.write_capture(folder, plan.projector_width, plan.projector_height, plan.layout, views)
    return folder


REAL = [u.strip() for u in os.environ.get("FRINGESCOPE_CONTRACT_URIS", "").split(",") if u.strip()]


@pytest.fixture(params=["simulated", "replay", *REAL])
def station(request: pytest.FixtureRequest) -> Iterator[Station]:
    """Every instrument in turn, opened afresh."""
    if request.param == "replay":
        uri = request.getfixturevalue("stored").as_uri()
    else:
        uri = SIMULATED if request.param == "simulated" else request.param
    with registry.open_station(uri) as s:
        yield s


@pytest.fixture
def shot(station: Station) -> Shot:
    """Three patterns, at a pace that every camera follows."""
    exposure = capture.timing(station.projector, station.cameras)
    patterns = tuple(PatternRef(stripes(station, 1 / 80, n, 5), f"step {n}") for n in range(3))
    return Shot(patterns, Exposure(exposure.duration_us, exposure.period_us))
