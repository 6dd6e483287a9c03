"""Frames on their way: what is done before the last has come changes nothing but the time; nothing is lost or left."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from fringescope import capture, patterns, pipeline
from fringescope.devices import registry
from fringescope.errors import CaptureError, DecodeError, IncompleteShotError, ResourceError
from fringescope.pipeline import arrival, fast
from fringescope.settings import CaptureSettings, Settings, from_dict
from fringescope.types import NoiseModel, PixelFormat, ViewInput
from tests.test_fused import PLANS, packed, rig_of, view_of
from tests.test_twin_end_to_end import view_of as captured

S = Settings()


def known(view):
    """The view with the noise that it was drawn with."""
    scale = view.plan.pixel_format.max_value / 255
    return replace(view, noise=NoiseModel(0.5 * scale**2, 0.02 * scale, "given"))


def arriving(view):
    return replace(view, frames=iter(view.frames))


def same(view, rig, s=S, sets=None):
    """A view decoded as its frames came is the view decoded at once, bit for bit; `sets` were done before the last."""
    come, begun = arrival.gathered(arriving(view), rig, s)
    assert [k for k, _ in come.frames] == [k for k, _ in view.frames]
    assert (None if begun is None else begun.sets) == sets
    want, got = fast.decode(view, rig, s), fast.decode(come, rig, s, "cpu", begun)
    for a, b in ((want.xyz, got.xyz), (want.sigma_mm, got.sigma_mm), (want.decoded.reasons, got.decoded.reasons),
                 (want.decoded.background, got.decoded.background), (want.decoded.modulation, got.decoded.modulation),
                 (want.decoded.directions[0].phase, got.decoded.directions[0].phase),
                 (want.decoded.directions[0].sigma, got.decoded.directions[0].sigma)):  # fmt: skip
        np.testing.assert_array_equal(b, a)
    assert (got.decoded.reasons == 0).mean() > 0.2
    return begun


@pytest.mark.parametrize("fmt", list(PixelFormat)[:-1])
@pytest.mark.parametrize("steps", [(4, 4, 8), (3, 5, 12)])
def test_every_pixel_format(fmt, steps):
    rig = rig_of(1190, 41)  # more than two blocks of pixels
    same(known(view_of(rig, rig.cameras[1], fmt, steps=steps)), rig, sets=2)


@pytest.mark.parametrize(("periods", "steps"), PLANS)
def test_every_plan(periods, steps):
    rig = rig_of()
    view = view_of(rig, rig.cameras[2], PixelFormat.MONO12, periods, steps)
    same(known(view), rig, sets=len(periods) - 1 or None)  # one set alone is left to the end


def test_sets_that_come_fine_first_are_left_to_the_end():
    rig = rig_of()
    view = view_of(rig, rig.cameras[0], PixelFormat.MONO8, flip=(0, 1), order=(2, 1, 0))
    same(view, rig, sets=None)


def test_saturated_samples_and_dark_pixels():
    rig = rig_of(1190, 41)
    view = known(view_of(rig, rig.cameras[1], PixelFormat.MONO8, A=0.8, B=0.4))
    assert np.mean([(f == 255).mean() for _, f in view.frames]) > 0.1
    same(view, rig, sets=2)


def test_packed_frames_and_rows_that_lie_apart():
    rig = rig_of(1166, 23)
    view = known(view_of(rig, rig.cameras[0], PixelFormat.MONO12, A=0.6, B=0.5))
    same(replace(view, frames=[(k, np.repeat(packed(f), 2, axis=0)[::2]) for k, f in view.frames]), rig, sets=2)


def test_without_a_volume_several_orders_come_into_question():
    rig = rig_of(volume=False)
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8, (40.0, 37.0, 16.0), (6, 6, 6))
    same(known(view), rig, sets=2)


def test_noise_that_the_frames_tell_is_that_of_the_sets_that_came():
    """It differs by its own error: no pixel more than a few at a threshold, no point that all frames keep."""
    rig = rig_of(1190, 101)
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8)
    come, begun = arrival.gathered(arriving(view), rig, S)
    want, got = fast.decode(view, rig, S), fast.decode(come, rig, S, "cpu", begun)
    assert begun.sets == 2
    assert begun.noise != want.decoded.noise
    assert (want.decoded.reasons != got.decoded.reasons).mean() < 2e-4
    both = (want.decoded.reasons | got.decoded.reasons) == 0
    np.testing.assert_array_equal(got.xyz[both], want.xyz[both])
    assert got.decoded.noise == want.decoded.noise


def test_what_was_begun_by_another_noise_is_begun_anew():
    rig = rig_of()
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8)
    come, begun = arrival.gathered(arriving(view), rig, S)
    want = fast.decode(view, rig, S)
    assert fast._still_holds(begun, fast.way_of(view, rig, S), S)
    for out in begun.out[:3]:  # nothing of it may be used
        out[:] = 1e9
    wrong = begun._replace(noise=NoiseModel(1.2 * begun.noise.a, 1.2 * begun.noise.b, "residuals"))
    got = fast.decode(come, rig, S, "cpu", wrong)
    np.testing.assert_array_equal(got.xyz, want.xyz)


def test_coarse_sets_are_worked_out_while_the_finest_is_on_its_way():
    rig = rig_of()
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8)
    beginning = fast.Beginning(view, rig, S)
    done = []
    for key, frame in view.frames:
        beginning.add(key, frame)
        done.append(beginning.begun.sets if beginning.begun else 0)
    assert done == [0] * 3 + [1] * 4 + [2] * 9


def test_one_buffer_for_all_frames_is_refused():
    rig = rig_of()
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8)
    ring = np.empty_like(view.frames[0][1])

    def frames():
        for key, frame in view.frames:
            ring[:] = frame
            yield key, ring

    with pytest.raises(CaptureError, match=r"lies in the memory of .* copy each one"):
        pipeline.scan_view(replace(view, frames=frames()), rig, S)


def test_a_camera_that_runs_on_is_refused():
    rig, views = three()
    asked = []

    def endless():
        for n in range(10_000):
            asked.append(n)
            yield views[0].frames[n % 16][0], views[0].frames[n % 16][1].copy()

    with pytest.raises(CaptureError, match="more than the plan's 16 frames came"):
        pipeline.scan([replace(views[0], frames=endless()), *views[1:]], rig)
    assert len(asked) <= 18


def test_frames_that_are_not_the_plans_are_refused_as_ever():
    rig = rig_of()
    view = view_of(rig, rig.cameras[1], PixelFormat.MONO8)
    key, last = view.frames[-1]
    for frames, error, words in (
        (view.frames[:-1], CaptureError, "missing"),
        ([*view.frames, view.frames[0]], CaptureError, "twice"),
        ([*view.frames[:-1], (key, last[1:])], CaptureError, "pixels"),
        ([(k, f[1:]) for k, f in view.frames], DecodeError, "157 x 82"),
        (view.frames[:3], CaptureError, "missing"),
        ([], CaptureError, "no frames"),
    ):
        with pytest.raises(error, match=words):
            pipeline.scan_view(replace(view, frames=iter(frames)), rig, S)


# --------------------------------------------------------------------------------------------------- views, in a thread


def three():
    rig = rig_of()
    return rig, [known(view_of(rig, c, PixelFormat.MONO8, seed=i)) for i, c in enumerate(rig.cameras)]


def test_a_scan_of_arriving_frames_is_the_scan_of_those_in_memory():
    rig, views = three()
    shown = []
    s = from_dict({"mesh": {"preview_pixels": 4000}})
    want = pipeline.scan(views, rig, s, first=shown.append)
    got = pipeline.scan([arriving(v) for v in views], rig, s, first=shown.append)
    mixed = pipeline.scan([views[0], arriving(views[1]), views[2]], rig, s, first=shown.append)
    for scan in (got, mixed):
        np.testing.assert_array_equal(scan.cloud.xyz, want.cloud.xyz)
        np.testing.assert_array_equal(scan.surface.vertices, want.surface.vertices)
    assert len(shown) == 3
    np.testing.assert_array_equal(shown[0].vertices, shown[1].vertices)
    np.testing.assert_array_equal(shown[0].vertices, shown[2].vertices)


def test_the_coarse_surface_waits_for_the_last_frame_but_not_for_the_fine_work_on_it():
    rig, views = three()
    told = []

    def frames(n):
        yield from views[n].frames
        told.append(n)

    arriving_ = [replace(v, frames=frames(n)) for n, v in enumerate(views)]
    steps = []
    pipeline.scan(arriving_, rig, from_dict({"mesh": {"preview_pixels": 4000}}), first=lambda _: steps.append("first"),
                  progress=lambda what, _: steps.append(what))  # fmt: skip
    assert told == [0, 1, 2]
    names = [v.plan.camera for v in views]
    assert steps[:5] == ["coarse surface", *(f"decoding {n}" for n in names), "first"]


def test_frames_are_read_in_order_by_one_thread_one_view_ahead():
    _, views = three()
    begun = [threading.Event() for _ in views]
    threads = set()

    def frames(n):
        begun[n].set()
        for one in views[n].frames:
            threads.add(threading.get_ident())
            yield one

    with arrival.Reader([replace(v, frames=frames(n)) for n, v in enumerate(views)]) as reader:
        first = reader.view(0)
        assert begun[1].wait(5.0)  # the next is read while the first is worked on
        assert [k for k, _ in first.frames] == [k for k, _ in views[0].frames]
        time.sleep(0.05)
        assert not begun[2].is_set()
        list(reader.view(1).frames)
        assert begun[2].wait(5.0)
        assert len(list(reader.view(2).frames)) == 16
    assert len(threads) == 1
    assert threading.get_ident() not in threads


def test_what_the_source_raises_is_raised_and_the_others_are_not_begun():
    rig, views = three()
    begun = []

    def broken():
        yield from views[1].frames[:5]
        raise IncompleteShotError("frame lost: set 1 step 2")

    def last():
        begun.append(True)
        yield from views[2].frames

    frames = (views[0].frames, broken(), last())
    with pytest.raises(IncompleteShotError, match="frame lost"):
        pipeline.scan([replace(v, frames=f) for v, f in zip(views, frames, strict=True)], rig)
    assert not begun
    assert not [t for t in threading.enumerate() if t.name == "frames"]


@pytest.mark.parametrize("error", [SystemExit, KeyboardInterrupt, GeneratorExit])
def test_whatever_the_source_raises_ends_the_scan(error):
    rig, views = three()

    class Source:
        def __iter__(self):
            yield from views[0].frames[:3]
            raise error

    with pytest.raises(error):
        pipeline.scan([replace(views[0], frames=Source())], rig)


def test_a_scan_that_fails_closes_the_source_that_is_being_read():
    rig, views = three()
    closed = threading.Event()

    def endless():
        try:
            while True:
                yield views[1].frames[0]
                time.sleep(0.001)
        finally:
            closed.set()

    short = replace(views[0], frames=iter(views[0].frames[:7]))
    with pytest.raises(CaptureError, match="missing"):
        pipeline.scan([short, replace(views[1], frames=endless())], rig)
    assert closed.is_set()
    assert not [t for t in threading.enumerate() if t.name == "frames"]


def test_a_source_that_stalls_is_left_to_itself(monkeypatch):
    rig, views = three()
    monkeypatch.setattr(arrival, "PATIENCE_S", 0.2)
    released, left = threading.Event(), threading.Event()

    def stalled():
        try:
            yield views[1].frames[0]
            released.wait(60)
        finally:
            left.set()

    try:
        short, slow = replace(views[0], frames=iter(views[0].frames[:7])), replace(views[1], frames=stalled())
        with pytest.raises(CaptureError, match="missing"):
            pipeline.scan([short, slow], rig)
        assert not left.is_set()
    finally:
        released.set()
    assert left.wait(5.0)


def test_frames_yet_to_come_count_by_their_format(monkeypatch):
    rig, views = three()
    rgb = [replace(v, plan=replace(v.plan, pixel_format=PixelFormat.RGB8), frames=iter(v.frames)) for v in views]
    room = {}
    for name, some in (("mono", [arriving(v) for v in views]), ("rgb", rgb), ("here", views)):
        for free in range(0, 6_000_000, 1000):
            monkeypatch.setattr(arrival.memory, "available", lambda free=free: free)
            try:
                arrival.fitted(some, rig)
            except ResourceError:
                continue
            room[name] = free
            break
    pixels = 157 * 83 * 16 * arrival.AHEAD
    assert abs(room["mono"] - room["here"] - pixels) <= 1000
    assert abs(room["rgb"] - room["here"] - 3 * pixels) <= 1000


def test_the_stages_take_frames_as_they_come_as_well():
    rig, views = three()
    rgb = PixelFormat.RGB8
    turned = [ViewInput(replace(v.plan, pixel_format=rgb), [(k, np.repeat(f[..., None], 3, 2)) for k, f in v.frames])
              for v in views]  # fmt: skip
    want = pipeline.scan(turned, rig)
    got = pipeline.scan([arriving(v) for v in turned], rig)
    assert {v["way"] for v in got.figures["views"].values()} == {"staged"}
    np.testing.assert_array_equal(got.cloud.xyz, want.cloud.xyz)


def test_an_instrument_is_scanned_while_it_records():
    """The twin's devices, view after view: the same surface as by frames that were collected before."""
    with registry.open_station("sim://pair/sphere?scale=0.1&seed=4") as station:
        rig = station.rig
        views = [captured(station, i) for i in range(len(rig.cameras))]
        want = pipeline.scan(views, rig)
    with registry.open_station("sim://pair/sphere?scale=0.1&seed=4") as station:
        live = []
        for n, v in enumerate(views):
            images = patterns.images(v.plan, rig.projector)
            frames = capture.stream(station.projector, station.cameras[n], images, v.plan, CaptureSettings())
            live.append(ViewInput(v.plan, frames, v.color, v.noise, v.response))
        got = pipeline.scan(live, rig)
    np.testing.assert_allclose(len(got.cloud.xyz), len(want.cloud.xyz), rtol=1e-3)

