"""The GPU without a GPU: its kernels as plain loops, in Numba's simulator, and compiled for a card that is not here."""

import importlib.util
import os
import subprocess
import sys
import types
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fringescope import gpu, pipeline
from fringescope.cli import run
from fringescope.errors import UsageError
from fringescope.kernels import gpu as k
from fringescope.pipeline import fast
from fringescope.types import PixelFormat
from tests.on_gpu import DARK, S, by_loops, empty, tables
from tests.test_fused import rig_of, view_of

ROOT = Path(__file__).resolve().parents[1]


def test_in_the_simulator():
    """Everything in on_gpu.py: whole views through streams, buffers and kernels, on small pictures."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/on_gpu.py"]
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | {"NUMBA_ENABLE_CUDASIM": "1"}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
    assert "skipped" not in done.stdout


@pytest.mark.parametrize(
    ("fmt", "periods", "steps", "brightness"),
    [
        (PixelFormat.MONO8, (270.0, 60.0, 16.0), (4, 4, 8), 0.4),
        (PixelFormat.MONO8, (270.0, 60.0, 16.0), (4, 4, 8), 0.85),
        (PixelFormat.BAYER_RG12, (270.0, 60.0, 16.0), (3, 3, 3), 0.4),
        (PixelFormat.MONO16, (270.0, 90.0, 40.0, 16.0), (4, 3, 5, 16), 0.4),
        (PixelFormat.MONO12, (250.0,), (8,), 0.4),
    ],
)
def test_a_thread_does_what_the_loops_do(fmt, periods, steps, brightness):
    """All pixels of a larger picture: reasons alike but for 0.1 % (a threshold within rounding), points to 20 nm."""
    rig = rig_of(357, 183)
    view = view_of(rig, rig.cameras[1], fmt, periods, steps, A=brightness, B=0.3)
    way = fast.way_of(view, rig, S)
    height, width = way.frames[0].shape
    want = empty(height, width)
    fast.on_cpu(way, tuple(want))
    got = by_loops(way)
    lit = ((want[4] | got[4]) & DARK) == 0
    assert ((want[4] != got[4]) & lit).mean() <= 0.001
    assert (((want[4] ^ got[4]) & DARK) != 0).mean() <= 0.001
    good = (want[4] == 0) & (got[4] == 0)
    assert good.mean() > 0.2
    largest = np.abs(want[0][good]).max()
    np.testing.assert_allclose(got[0][good], want[0][good], rtol=0, atol=4 * np.spacing(largest))
    np.testing.assert_allclose(got[5][good], want[5][good], rtol=0, atol=2e-5)
    for n in (1, 2, 3, 6):
        np.testing.assert_allclose(got[n][good], want[n][good], rtol=1e-5)


@pytest.mark.parametrize("dtype", [PixelFormat.MONO8, PixelFormat.MONO16])
def test_kernels_compile_for_a_gpu(dtype, monkeypatch):
    """To the assembler of an H100, by NVIDIA's compiler, which needs no GPU; nothing falls back to memory."""
    if importlib.util.find_spec("numba_cuda") is None:
        pytest.skip("numba-cuda is not installed: pip install 'fringescope[gpu]'")
    from numba import cuda, typeof, void
    from numba.cuda import dispatcher

    card = types.SimpleNamespace(compute_capability=(9, 0))
    monkeypatch.setattr(dispatcher, "get_current_device", lambda: card)
    rig = rig_of(64, 9)
    way = fast.way_of(view_of(rig, rig.cameras[1], dtype), rig, S)
    height, width = way.frames[0].shape
    nodes, rows = tables(way, height)
    band = k.Band(np.stack(way.frames), 0, *empty(height, width))
    for kernel, args in [
        (k._rows, (height, way.depths, nodes, rows)),
        (k._decode, (band, way.sets, way.limits, rows, way.depths)),
        (k._clipped, (band, way.sets, way.limits, rows, way.depths)),
    ]:
        ptx, _ = cuda.compile_ptx(kernel.py_func, void(*(typeof(a) for a in args)), cc=card.compute_capability)
        assert ".visible .entry" in ptx
        assert "sm_90" in ptx


def test_what_is_missing_is_said(monkeypatch, capsys):
    rig = rig_of(64, 9)
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8)
    monkeypatch.setattr(gpu.importlib.util, "find_spec", lambda _name: None)
    with pytest.raises(UsageError, match=r"device 'gpu': numba-cuda is not installed; pip install .*, or take"):
        pipeline.scan_view(view, rig, S, device="gpu")
    with pytest.raises(UsageError, match="numba-cuda is not installed"):
        pipeline.scan([view], rig, S, device="gpu")
    assert run(["reconstruct", "nothing", "--rig", "nothing", "--out", "nowhere", "--device", "gpu"]) == 2
    assert "numba-cuda is not installed" in capsys.readouterr().err
    monkeypatch.setattr(gpu.importlib.util, "find_spec", lambda _name: object())
    monkeypatch.setattr(gpu.cuda, "is_available", lambda: False)
    with pytest.raises(UsageError, match="finds no NVIDIA GPU"):
        pipeline.scan_view(view, rig, S, device="gpu")


def test_a_device_that_does_not_exist():
    rig = rig_of(64, 9)
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8)
    with pytest.raises(UsageError, match="device 'tpu'; needed cpu or gpu"):
        pipeline.scan_view(view, rig, S, device="tpu")
    with pytest.raises(UsageError, match="needed cpu or gpu"):
        pipeline.scan([replace(view)], rig, S, device="GPU")


def test_nobody_imports_cuda_who_does_not_ask_for_it():
    code = "import sys, fringescope.cli, fringescope.pipeline; assert 'numba.cuda' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=120).returncode == 0
