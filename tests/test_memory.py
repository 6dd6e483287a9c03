"""Large arrays that are used again, and scans that are refused where memory is short."""

import gc

import numpy as np
import pytest

from fringescope import memory, pipeline
from fringescope.errors import ResourceError
from fringescope.types import PixelFormat
from tests.test_fused import rig_of, view_of

LARGE = (1024, 1024)  # float32: four megabytes


@pytest.fixture(autouse=True)
def _nothing_idle():
    gc.collect()
    memory.release()
    yield
    memory.release()


def address(a):
    return a.__array_interface__["data"][0]


def test_memory_comes_back_when_the_last_view_is_gone():
    a = memory.empty(LARGE, np.float32)
    a[:] = 7
    where, part = address(a), a[5:9, ::2]
    del a
    b = memory.empty(LARGE, np.float32)
    b[:] = 1
    assert address(b) != where
    assert (part == 7).all()
    del part
    c = memory.empty((2048, 1024), np.uint16)  # of another type and shape, but as large
    assert address(c) == where
    assert c.flags.writeable
    assert c.flags.c_contiguous


def test_arrays_in_use_never_share_memory(rng):
    alive = {}
    for n in range(200):
        if alive and rng.random() < 0.5:
            del alive[rng.choice(list(alive))]
        a = memory.empty((int(rng.integers(300, 900)), 1000), rng.choice([np.float32, np.uint16, np.float64]))
        a[:] = n % 100
        alive[n] = a
    assert all((a == n % 100).all() for n, a in alive.items())


def test_blocks_much_too_large_are_left_alone_and_idle_ones_are_bounded(monkeypatch):
    a = memory.empty((8 << 20,), np.uint8)
    where = address(a)
    del a
    assert address(memory.empty((4 << 20,), np.uint8)) != where
    monkeypatch.setattr(memory, "KEPT", 10 << 20)
    many = [memory.empty((4 << 20,), np.uint8) for _ in range(5)]
    del many
    gc.collect()
    assert sum(one.nbytes for one in memory._idle) <= 10 << 20
    memory.release()
    assert not memory._idle


def test_small_and_empty_arrays_are_plain():
    assert memory.empty((10, 10), np.float32).base is None
    assert memory.empty((0, 5), np.uint8).shape == (0, 5)


def test_a_scan_that_does_not_fit_is_refused_with_figures(monkeypatch):
    assert memory.available() is None or memory.available() > 1 << 20
    rig = rig_of()
    views = [view_of(rig, c, PixelFormat.MONO8) for c in rig.cameras]
    monkeypatch.setattr(memory, "available", lambda: 1_000_000)
    with pytest.raises(ResourceError, match=r"3 views, 0.0 megapixels in all, need about 0.0 GB of memory; 0.0 GB are"):
        pipeline.scan(views, rig)
    monkeypatch.setattr(memory, "available", lambda: None)  # unknown: it is tried
    assert len(pipeline.scan(views, rig, surface=False).cloud) > 100
