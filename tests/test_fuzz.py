"""Damaged and hostile files: whatever is in them, the answer is a FringescopeError or a valid object."""

from __future__ import annotations

import contextlib
import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fringescope import export, store
from fringescope.errors import CaptureError, FormatError, FringescopeError, UsageError
from fringescope.importing.loose import Gray, Recipe, stack_pages
from fringescope.store.images import Images
from fringescope.types import Cloud, FringeSet, GraySet, Layout, PixelFormat, ViewInput, ViewPlan

FUZZ = settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)

SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 3),
    st.sampled_from([10**6, 10**12, -(2**63), 10**400, 1e308, -1e-320, float("nan"), float("inf"), -float("inf")]),
    st.sampled_from(
        [
            "",
            ".",
            "..",
            "../../etc/passwd",
            "/etc/passwd",
            "C:\\x",
            "camera1/00.png",
            "camera1",
            "s.tif#0",
            "s.tif#99",
            "s.tif",
            "a#b",
            "\x00",
            "\ud800",
            "\n",
            "x" * 5000,
            "u",
            "v",
            "Mono8",
            "Mono12",
            "RGB8",
            "diamond",
            "~",
            "camera1/../camera1/00.png",
            "nul",
            "é",
        ]
    ),
    st.text(max_size=8),
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=6), inner, max_size=3)),
    max_leaves=6,
)


def places(doc: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of every value inside a JSON document."""
    items = doc.items() if isinstance(doc, dict) else enumerate(doc) if isinstance(doc, list) else ()
    for key, value in items:
        yield (*path, key)
        yield from places(value, (*path, key))


def mutated(doc: Any, data: st.DataObject) -> Any:
    """One to three values replaced, dropped, doubled or swapped."""
    doc = copy.deepcopy(doc)
    for _ in range(data.draw(st.integers(1, 3))):
        every = list(places(doc))
        if not every:
            break
        *above, last = data.draw(st.sampled_from(every))
        holder = doc
        for key in above:
            holder = holder[key]
        how = data.draw(st.sampled_from(["replace", "drop", "double", "wrap", "borrow"]))
        if how == "replace":
            holder[last] = data.draw(VALUES)
        elif how == "drop":
            del holder[last]
        elif how == "double" and isinstance(holder, list):
            holder.append(copy.deepcopy(holder[last]))
        elif how == "wrap":
            holder[last] = [holder[last]]
        else:
            other = doc
            for key in data.draw(st.sampled_from(list(places(doc)))):
                other = other[key]
            holder[last] = copy.deepcopy(other)
    return doc


def one_line(e: Exception, names: str = "") -> None:
    assert "\n" not in str(e)
    assert names in str(e)
    str(e).encode()  # can be printed


def write(path: Path, doc: Any) -> None:
    path.write_bytes(json.dumps(doc).encode("utf-8", "surrogatepass"))


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    sets = (FringeSet((0.01, 0.0), 3), FringeSet((0.1, 0.0), 4, 500.0), GraySet("u", 8.0, 2, True, True, True))
    plan = ViewPlan("camera1", PixelFormat.MONO8, sets, (100, 80))
    frames = [(k, np.full((6, 8), 10 * i, np.uint8)) for i, k in enumerate(plan.keys)]
    out = tmp_path_factory.mktemp("fuzz") / "capture"
    store.write_capture(out, 100, 80, Layout.GRID, [ViewInput(plan, frames, frames[0][1])])
    tifffile.imwrite(out / "s.tif", np.zeros((3, 6, 8), np.uint8), photometric="minisblack")
    return out


@FUZZ
@given(data=st.data())
def test_capture_json(capture: Path, data: st.DataObject) -> None:
    path = capture / "fuzzed.json"
    write(path, mutated(json.loads((capture / "capture.json").read_text()), data))
    try:
        c = store.read_capture(path)
        views = store.view_inputs(c)
        for v, view in zip(views, c.views, strict=True):
            keys = [k for k, _ in v.frames]
            assert keys == list(view.plan.keys)
        assert store.hash_capture(c).startswith("sha256:")
    except FringescopeError as e:
        one_line(e)
    else:
        inside = capture.resolve()
        for view in c.views:
            for name in view.files:
                assert (c.folder / name.split("#")[0]).resolve().is_relative_to(inside)


RIG: dict[str, Any] = {
    "format": "fringescope-rig", "version": 1, "units": "mm",
    "projector": {"width": 100, "height": 80, "layout": "grid", "K": [[500.0, 0, 50], [0, 500.0, 40], [0, 0, 1]],
                  "distortion": [0.1, 0, 0, 0, 0], "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "t": [0, 0, 0]},
    "cameras": [{"name": "camera1", "width": 8, "height": 6, "K": [[500.0, 0, 4], [0, 500.0, 3], [0, 0, 1]],
                 "distortion": [0.1, 0, 0, 0, 0], "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "t": [-100, 0, 0]}],
    "volume": {"center": [0, 0, 500], "axes": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "half_size": [50, 30, 20]},
}  # fmt: skip


@FUZZ
@given(data=st.data())
def test_rig_json(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "rig.json"
    write(path, mutated(RIG, data))
    try:
        rig = store.read_rig(path)
    except FringescopeError as e:
        one_line(e)
        return
    for device in rig.devices:
        assert np.isfinite(device.lens.K).all()
        assert np.linalg.matrix_rank(device.lens.K) == 3
        assert np.isfinite(device.pose.t).all()
    store.write_rig(tmp_path / "again.json", rig, force=True)
    again = store.read_rig(tmp_path / "again.json")
    assert [c.name for c in again.cameras] == [c.name for c in rig.cameras]
    np.testing.assert_array_equal(again.projector.lens.K, rig.projector.lens.K)


@FUZZ
@given(data=st.data())
def test_scan_json(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    folder = tmp_path_factory.mktemp("scan")
    (folder / "camera1").mkdir()
    for name, shape, kind in (("xyz", (3, 4, 3), "f4"), ("sigma", (3, 4), "f4"), ("reasons", (3, 4), "u2")):
        np.save(folder / "camera1" / f"{name}.npy", np.zeros(shape, kind))
    views = [{"view": 0, "camera": "camera1", "size": [4, 3]}]
    doc = {
        "format": "fringescope-scan",
        "version": 1,
        "grids": "npy",
        "views": views,
        "files": {"camera1/xyz.npy": "x"},
    }
    write(folder / "scan.json", mutated(doc, data))
    try:
        scan = store.read_scan(folder, check=False)
    except FringescopeError as e:
        one_line(e)
        return
    for g in scan.grids:
        assert g.xyz.shape == (*g.reasons.shape, 3)


@FUZZ
@given(st.binary(max_size=60), st.sampled_from(["", '{"format": "fringescope-rig", "version": ', "[[[["]))
def test_any_bytes_as_a_document(tmp_path: Path, tail: bytes, head: str) -> None:
    path = tmp_path / "x.json"
    path.write_bytes(head.encode() + tail)
    for reader in (store.read_rig, store.read_capture, store.read_scan):
        with pytest.raises(FringescopeError):
            reader(path)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("images")
    picture = np.random.default_rng(0).integers(0, 255, (9, 11)).astype(np.uint8)
    cv2.imwrite(str(out / "a.png"), picture)
    tifffile.imwrite(out / "b.tif", np.stack([picture] * 3), photometric="minisblack")
    tifffile.imwrite(out / "c.tif", picture, photometric="minisblack", compression="zlib")
    cv2.imwrite(str(out / "d.tif"), picture, [cv2.IMWRITE_TIFF_COMPRESSION, 5])
    return out


@FUZZ
@given(
    st.sampled_from(["a.png", "b.tif", "c.tif", "d.tif"]),
    st.lists(st.tuples(st.integers(0, 5000), st.integers(0, 255)), max_size=4),
    st.integers(0, 5000),
)
def test_damaged_images(images: Path, name: str, flips: list[tuple[int, int]], cut: int) -> None:
    data = bytearray((images / name).read_bytes())
    for at, value in flips:
        data[at % len(data)] = value
    (images / f"x{name}").write_bytes(data[: len(data) - cut % len(data)] if cut % 3 == 0 else data)
    frame = f"x{name}#1" if name == "b.tif" else f"x{name}"
    try:
        Images(images).header(frame)
        got = Images(images).frame(frame, PixelFormat.MONO8, (11, 9))
    except CaptureError as e:
        one_line(e, name)
    else:
        assert got.shape == (9, 11)
        assert got.dtype == np.uint8
    if name.endswith(".tif"):
        with contextlib.suppress(CaptureError, UsageError):
            stack_pages(images / f"x{name}", None, None, None)


@FUZZ
@given(st.lists(st.tuples(st.integers(0, 5000), st.integers(0, 255)), max_size=4), st.integers(0, 5000))
def test_damaged_clouds(images: Path, flips: list[tuple[int, int]], cut: int) -> None:
    zeros = np.zeros((5, 3), np.float32)
    path = images / "c.ply"
    export.write_ply(Cloud(zeros, zeros, zeros.astype(np.uint8), zeros[:, 0], zeros[:, 0].astype(np.uint8)), path)
    data = bytearray(path.read_bytes())
    for at, value in flips:
        data[at % len(data)] = value
    path.write_bytes(data[: len(data) - cut % len(data)])
    try:
        assert export.read_ply(path).xyz.shape[1] == 3
    except FormatError as e:
        one_line(e)


@FUZZ
@given(
    st.lists(st.integers(-1, 9), max_size=4),
    st.lists(st.floats(-10, 2000) | st.just(float("nan")), max_size=4),
    st.lists(st.integers(-1, 8), max_size=5),
    st.floats(-720, 720) | st.just(float("inf")),
    st.booleans(),
    st.sampled_from([None, ("u", 4.0, 3, "pairs"), ("w", 4.0, 3, "none"), ("v", -1.0, 0, "after"), ("v", 1.0, 2, "x")]),
)
def test_recipes(
    steps: list[int], periods: list[float], order: list[int], first: float, interleaved: bool, gray: Any
) -> None:
    """Every file is used exactly once, or the recipe is refused."""
    try:
        code = None if gray is None else Gray(*gray)
        recipe = Recipe(tuple(steps), tuple(periods), step_order=tuple(order), first_phase_deg=first, gray=code,
                        interleaved=interleaved)  # fmt: skip
        used = recipe.order()
        plan = recipe.plan("camera1", PixelFormat.MONO8)
    except FringescopeError:
        return
    assert sorted(used) == list(range(recipe.files_needed))
    assert len(plan.keys) == recipe.files_needed
