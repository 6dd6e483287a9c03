"""Frames that do not fit into memory: some rows at a time, with the same results; or a refusal, with figures."""

import json
import subprocess
import sys
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from fringescope import memory, pipeline, store
from fringescope.cli import run
from fringescope.errors import CaptureError, ResourceError
from fringescope.pipeline import arrival, fast, tiling
from fringescope.settings import Settings
from fringescope.store.images import write_tiff
from fringescope.types import Layout, PixelFormat, Reason, RowFrames
from tests.test_fused import packed, rig_of, view_of

S = Settings()


@pytest.fixture(autouse=True)
def _small_pictures(monkeypatch):
    """Whose arrays are no larger than said."""
    monkeypatch.setattr(arrival, "SLACK", 0)


class OnDisk:
    """Frames of which rows can be had; counts how many rows of all of them were asked for at a time."""

    def __init__(self, frames):
        self.frames, self.asked, self.whole = list(frames), [], 0

    def __iter__(self):
        self.whole += 1
        return iter([(key, f.copy()) for key, f in self.frames])

    def rows(self, first, last):
        self.asked.append(last - first)
        for key, f in self.frames:
            yield key, f[first:last].copy()


def budget_for(view, rig, rows, alone=True):
    """Bytes with which so many rows of a view's frames are held at a time."""
    lens = rig.camera(view.plan.camera).lens
    least = lens.width * lens.height * (arrival.VIEW_BYTES + (0 if alone else arrival.KEPT_BYTES + arrival.CLOUD_BYTES))
    return least + arrival.SLACK + rows * lens.width * len(view.plan.keys) * view.plan.pixel_format.dtype.itemsize


def same(got, want):
    decoded, grid = got
    expected, whole = want
    for a, b in (
        (grid.xyz, whole.xyz),
        (grid.sigma, whole.sigma),
        (grid.reasons, whole.reasons),
        (decoded.background, expected.background),
        (decoded.modulation, expected.modulation),
        (decoded.directions[0].phase, expected.directions[0].phase),
        (decoded.directions[0].sigma, expected.directions[0].sigma),
    ):
        np.testing.assert_array_equal(a, b)
    assert decoded.noise == expected.noise
    assert whole.valid.mean() > 0.2


@pytest.mark.parametrize("fmt", [PixelFormat.MONO8, PixelFormat.BAYER_RG12, PixelFormat.MONO16])
@pytest.mark.parametrize("rows", [27, 64])
def test_a_view_by_rows_is_the_view_at_once(fmt, rows):
    rig = rig_of(620, 131)
    view = view_of(rig, rig.cameras[1], fmt, steps=(4, 5, 8), A=0.55, B=0.43)
    disk = OnDisk(view.frames)
    assert isinstance(disk, RowFrames)
    got = pipeline.scan_view(replace(view, frames=disk), rig, S, budget=budget_for(view, rig, rows))
    assert disk.whole == 0
    assert disk.asked[0] == 132  # each once, one at a time
    assert max(disk.asked[1:]) == rows
    assert sum(disk.asked[1:]) == 131
    same(got, pipeline.scan_view(view, rig, S))


def test_packed_frames_by_rows():
    rig = rig_of(620, 67)
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO12, A=0.6, B=0.5)
    disk = OnDisk([(k, packed(f)) for k, f in view.frames])
    got = pipeline.scan_view(replace(view, frames=disk), rig, S, budget=budget_for(view, rig, 20))
    assert max(disk.asked[1:]) == 20
    same(got, pipeline.scan_view(view, rig, S))


def test_orders_that_neighbours_repair_do_not_know_of_the_bands():
    """What looks at neighbours looks at the whole view: votes and masks see over the edges of bands."""
    rig = rig_of(620, 131)
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8, (270.0, 16.0), (3, 8), B=0.03, A=0.5)
    s = replace(S, phase=replace(S.phase, order_min_margin=1.5), denoise=replace(S.denoise, max_sigma_rad=1.0))
    want = pipeline.scan_view(view, rig, s)
    assert (want[1].reasons & (Reason.JUMP | Reason.NOT_LOCAL)).any()
    disk = OnDisk(view.frames)
    same(pipeline.scan_view(replace(view, frames=disk), rig, s, budget=budget_for(view, rig, 37)), want)


def test_frames_that_fit_are_taken_as_ever():
    rig = rig_of()
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8)
    disk = OnDisk(view.frames)
    same(pipeline.scan_view(replace(view, frames=disk), rig, S), pipeline.scan_view(view, rig, S))
    assert (disk.whole, disk.asked) == (1, [])


def test_a_scan_by_rows_is_the_scan_at_once():
    rig = rig_of(300, 83)
    views = [view_of(rig, c, PixelFormat.MONO16, steps=(8, 8, 8), seed=i) for i, c in enumerate(rig.cameras)]
    shown = []
    want = pipeline.scan(views, rig, S, first=shown.append)
    disks = [OnDisk(v.frames) for v in views]
    n = 300 * 83
    budget = n * (arrival.VIEW_BYTES + 3 * (arrival.KEPT_BYTES + arrival.CLOUD_BYTES)) + 40 * 300 * 24 * 2
    budget += arrival.SLACK
    tiled = [replace(v, frames=d) for v, d in zip(views, disks, strict=True)]
    got = pipeline.scan(tiled, rig, S, budget=budget, first=shown.append)
    assert [max(d.asked[1:]) for d in disks] == [40] * 3
    np.testing.assert_array_equal(got.cloud.xyz, want.cloud.xyz)
    np.testing.assert_array_equal(got.surface.vertices, want.surface.vertices)
    np.testing.assert_array_equal(shown[0].vertices, shown[1].vertices)


def test_what_does_not_fit_by_rows_is_refused_with_the_figure():
    rig = rig_of(620, 131)
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8)
    disk = OnDisk(view.frames)
    with pytest.raises(ResourceError, match=r"1 view, 0.1 megapixels in all, need about 0.0 GB of memory, a few"):
        pipeline.scan_view(replace(view, frames=disk), rig, S, budget=620 * 131 * arrival.VIEW_BYTES)
    assert (disk.whole, disk.asked) == (0, [])
    with pytest.raises(ResourceError, match=r"1 view, 0.1 megapixels in all, need about 0.0 GB of memory; 0.0 GB are"):
        pipeline.scan_view(replace(view, frames=iter(view.frames)), rig, S, budget=budget_for(view, rig, 50))
    huge = replace(view, frames=OnDisk([]))
    big = rig_of(62_000, 48_000)
    with pytest.raises(ResourceError, match=r"2976.0 megapixels in all, need about 1\d\d.\d GB of memory, a few"):
        pipeline.scan_view(huge, big, S, budget=10**9)


def test_plans_for_the_stages_are_not_tiled():
    rig = rig_of()
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8)
    sets = tuple(replace(one, exposure_us=e) for one, e in zip(view.plan.sets, (4000, 4000, 1000), strict=True))
    staged = replace(view, plan=replace(view.plan, sets=sets))
    assert not fast.takes(staged)
    with pytest.raises(ResourceError, match="close other programs"):
        pipeline.scan_view(replace(staged, frames=OnDisk(view.frames)), rig, S, budget=budget_for(view, rig, 30))


def test_frames_that_do_not_fit_the_plan_are_refused_by_rows_too():
    rig = rig_of(620, 67)
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8)
    key, last = view.frames[-1]
    for frames, words in (
        (view.frames[:-1], "missing"),
        ([*view.frames, view.frames[0]], "twice"),
        ([*view.frames[:-1], (key, last[1:])], "pixels"),
    ):
        with pytest.raises(CaptureError, match=words):
            pipeline.scan_view(replace(view, frames=OnDisk(frames)), rig, S, budget=budget_for(view, rig, 20))


@pytest.mark.parametrize("change", ["size", "type", "lost"])
def test_files_that_change_meanwhile_are_refused(change):
    rig = rig_of(620, 67)
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8)

    class Changing(OnDisk):
        def rows(self, first, last):
            for n, (key, some) in enumerate(super().rows(first, last)):
                if len(self.asked) < 3 or n != 5:
                    yield key, some
                elif change != "lost":
                    yield key, some[1:] if change == "size" else some.astype(np.uint16)

    with pytest.raises(CaptureError, match="of the frames are not what they were at first; needed files that"):
        pipeline.scan_view(replace(view, frames=Changing(view.frames)), rig, S, budget=budget_for(view, rig, 20))


# ------------------------------------------------------------------------------------------------- captures on a disk


def captured(folder, view, suffix=".png"):
    """A capture's folder whose frames are files of some kind."""
    plan = view.plan
    store.write_capture(folder, plan.projector_size[0], plan.projector_size[1], Layout.GRID, [view])
    document = json.loads((folder / "capture.json").read_text())
    if suffix != ".png":
        for one, (key, frame) in zip(
            [(s, n) for s in document["views"][0]["sets"] for n in range(len(s["frames"]))], view.frames, strict=True
        ):
            name = f"{key.set_index}-{key.number}.tif"
            one[0]["frames"][one[1]] = name
            if suffix == ".deflate":
                import tifffile

                tifffile.imwrite(folder / name, frame, compression="zlib")
            else:
                write_tiff(folder / name, frame)
        (folder / "capture.json").write_text(json.dumps(document))
    return store.view_inputs(store.read_capture(folder), rowed=True)[0]


@pytest.mark.parametrize("suffix", [".png", ".tif", ".deflate"])
def test_rows_of_files(tmp_path, suffix):
    rig = rig_of(620, 67)
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO12)
    stored = captured(tmp_path / "a", view, suffix)
    for first, last in ((0, 67), (0, 68), (5, 31), (60, 90)):
        there = list(stored.frames.rows(first, last))
        assert [key for key, _ in there] == list(view.plan.keys)
        for (_, a), (_, b) in zip(there, view.frames, strict=True):
            np.testing.assert_array_equal(a, b[first:last])
            assert a.dtype == b.dtype
    for (_, a), (_, b) in zip(stored.frames, view.frames, strict=True):
        np.testing.assert_array_equal(a, b)
    mapped = stored.frames._spool._keys == []
    assert mapped == (suffix == ".tif")
    same(pipeline.scan_view(stored, rig, S, budget=budget_for(view, rig, 20)), pipeline.scan_view(view, rig, S))


def test_pages_of_a_stack_and_files_of_another_machine(tmp_path):
    import tifffile

    rig = rig_of(620, 67)
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO12)
    captured(tmp_path / "a", view)
    document = json.loads((tmp_path / "a" / "capture.json").read_text())
    tifffile.imwrite(tmp_path / "a" / "stack.tif", np.stack([f for _, f in view.frames[:8]]), photometric="minisblack")
    tifffile.imwrite(tmp_path / "a" / "big.tif", view.frames[8][1].astype(">u2"), byteorder=">")
    names = [f"stack.tif#{n}" for n in range(8)] + ["big.tif"]
    for one, n in [(s, n) for s in document["views"][0]["sets"] for n in range(len(s["frames"]))][:9]:
        one["frames"][n] = names.pop(0)
    (tmp_path / "a" / "capture.json").write_text(json.dumps(document))
    (stored,) = store.view_inputs(store.read_capture(tmp_path / "a"), rowed=True)
    for (_, a), (_, b) in zip(stored.frames.rows(3, 40), view.frames, strict=True):
        np.testing.assert_array_equal(a, b[3:40])


def test_a_damaged_file_is_said_by_rows_too(tmp_path):
    rig = rig_of(620, 67)
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO12)
    stored = captured(tmp_path / "a", view, ".tif")
    path = tmp_path / "a" / "2-3.tif"
    path.write_bytes(path.read_bytes()[:30_000])
    with pytest.raises(CaptureError, match=r"2-3.tif"):
        pipeline.scan_view(stored, rig, S, budget=budget_for(view, rig, 20))
    wrong = view.frames[3][1].copy()
    wrong[40, 5] = 5000
    write_tiff(tmp_path / "a" / "2-3.tif", wrong)
    with pytest.raises(CaptureError, match=r"2-3.tif: values up to 5000; Mono12 goes to 4095"):
        pipeline.scan_view(stored, rig, S, budget=budget_for(view, rig, 20))


def test_reconstruct_takes_rows_where_memory_is_short(tmp_path, monkeypatch):
    """The verb, end to end: the same cloud, to the byte, with frames that would not fit."""
    rig = rig_of(300, 83)
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO16, steps=(8, 8, 8))
    captured(tmp_path / "capture", view)
    store.write_rig(tmp_path / "rig.json", rig)
    n, taken, clouds = 300 * 83, [], []
    budget = n * (arrival.VIEW_BYTES + arrival.KEPT_BYTES + arrival.CLOUD_BYTES) + 20 * 300 * 24 * 2
    in_bands = tiling.ByRows.in_bands
    monkeypatch.setattr(tiling.ByRows, "in_bands", lambda self, *a: (taken.append(self.rows), in_bands(self, *a))[1])
    for name, free in (("whole", None), ("rows", budget)):
        monkeypatch.setattr(memory, "available", lambda free=free: free)
        out, how = tmp_path / name, ["--rig", str(tmp_path / "rig.json"), "--out"]
        assert run(["reconstruct", str(tmp_path / "capture"), *how, str(out)]) == 0
        clouds.append((out / "cloud.ply").read_bytes())
    assert taken == [20]
    assert clouds[0] == clouds[1]


def many(rig):
    """A view of which the frames are most: 72 of 16 bits."""
    return view_of(rig, rig.cameras[1], PixelFormat.MONO16, steps=(24, 24, 24))


def test_what_is_held_stays_within_the_budget(monkeypatch):
    monkeypatch.setattr(memory, "STEP", 1 << 12)  # as for large pictures, whose arrays are much larger than a block
    monkeypatch.setattr(memory, "SMALL", 1 << 15)
    monkeypatch.setattr(arrival, "SLACK", 1 << 20)
    rig = rig_of(620, 300)
    view = many(rig)
    frames = sum(f.nbytes for _, f in view.frames)
    budget = frames // 2
    same(pipeline.scan_view(replace(view, frames=OnDisk(view.frames)), rig, S, budget=budget),
         pipeline.scan_view(view, rig, S))  # fmt: skip
    memory.release()
    tracemalloc.start()
    try:
        pipeline.scan_view(replace(view, frames=OnDisk(view.frames)), rig, S, budget=budget)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < budget


PEAK = """
import sys
from pathlib import Path
from fringescope import memory, pipeline, store
from fringescope.cli import run
from fringescope.settings import Settings

def told(what):
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(lines[what].split()[0]) * 1024

def scan(folder, budget):
    (view,) = store.view_inputs(store.read_capture(folder), rowed=True)
    decoded, grid = pipeline.scan_view(view, store.read_rig(folder + "/rig.json"), Settings(), budget=budget)
    return int(grid.valid.sum())

scan(sys.argv[1], None)  # imports and kernels
pipeline.arrival.SLACK, slack = 0, pipeline.arrival.SLACK
scan(sys.argv[1], int(sys.argv[3]))
pipeline.arrival.SLACK = slack
memory.release()
before = told("VmRSS")
Path("/proc/self/clear_refs").write_text("5")
points = scan(sys.argv[2], int(sys.argv[4]) or None)
print(points, told("VmHWM") - before)
"""


@pytest.mark.verify
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the peak of a process is told by /proc")
def test_a_capture_of_twice_the_budget_stays_within_it(tmp_path):
    """Peak resident memory of a process of its own: within the budget by rows; well above it with frames in memory."""
    for name, size in (("small", (620, 67)), ("large", (1240, 900))):
        rig = rig_of(*size)
        view = many(rig)
        captured(tmp_path / name, view, ".tif")
        store.write_rig(tmp_path / name / "rig.json", rig)
        if name == "small":
            warm = budget_for(view, rig, 20)
    frames = sum(f.nbytes for _, f in view.frames)
    budget = frames // 2
    peaks, points = [], []
    for given in (budget, 0):
        command = [sys.executable, "-c", PEAK, str(tmp_path / "small"), str(tmp_path / "large"), str(warm), str(given)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        count, peak = done.stdout.split()
        points.append(int(count))
        peaks.append(int(peak))
    assert points[0] == points[1] > 100_000
    assert peaks[0] < budget
    assert peaks[1] > frames


def test_bands_are_as_high_as_memory_allows_and_sixteen_rows_at_least():
    rig = rig_of(620, 131)
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8)
    (one,) = arrival.fitted([replace(view, frames=OnDisk([]))], rig, budget_for(view, rig, 100), alone=True)
    assert isinstance(one.frames, tiling.ByRows)
    assert one.frames.rows == 100
    plain = replace(view, frames=OnDisk([]))
    assert arrival.fitted([plain], rig, 10**9, alone=True) == (plain,)
