"""Captures, rigs and scans on disk: what is written is read back, and other people's captures are read as they are."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st

from fringescope import geometry, store
from fringescope.errors import CaptureError, FormatError, OutputError, RigError
from fringescope.store.images import Images, decode_png, write_png
from fringescope.twin import presets
from fringescope.types import (
    Cloud,
    Decoded,
    Direction,
    FrameKey,
    FringeSet,
    GraySet,
    Grid,
    Layout,
    Lens,
    NoiseModel,
    Picture,
    PixelFormat,
    Reason,
    Role,
    Scan,
    Surface,
    SurfacePart,
    ViewInput,
    ViewPlan,
    ViewVerdict,
    plane_size,
)

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/data is absent")
RNG = np.random.default_rng(7)


def frames_of(plan: ViewPlan, shape: tuple[int, ...] = (12, 17)) -> list[tuple[FrameKey, Any]]:
    top = plan.pixel_format.max_value
    return [(k, RNG.integers(0, top + 1, shape).astype(plan.pixel_format.dtype)) for k in plan.keys]


def plan(fmt: PixelFormat = PixelFormat.MONO8, camera: str = "camera1", layout: Layout = Layout.GRID) -> ViewPlan:
    sets = (
        FringeSet((0.0, 1 / 36), 4),
        FringeSet((0.0, 1 / 36), 4, exposure_us=4000.0),
        GraySet("u", 100.0, 3, inverse=True, white=True, black=True),
        FringeSet((0.01, 0.002), 3),
    )
    return ViewPlan(camera, fmt, sets, plane_size(91, 114, layout))


# ---------------------------------------------------------------------------------------------------------- captures


@pytest.mark.parametrize("fmt", list(PixelFormat))
def test_capture_comes_back_as_it_was_written(tmp_path: Path, fmt: PixelFormat) -> None:
    p = plan(fmt, layout=Layout.DIAMOND)
    shape = (12, 17, 3) if fmt is PixelFormat.RGB8 else (12, 17)
    frames = frames_of(p, shape)
    color = frames[0][1]
    shuffled = [frames[i] for i in RNG.permutation(len(frames))]
    view = ViewInput(p, shuffled, color, NoiseModel(1.5, 0.25))
    store.write_capture(tmp_path / "c", 91, 114, Layout.DIAMOND, [view], extra={"operator": "x"})
    back = store.read_capture(tmp_path / "c")
    assert (back.projector_width, back.projector_height, back.layout) == (91, 114, Layout.DIAMOND)
    assert back.extra["operator"] == "x"
    assert back.views[0].plan == p
    assert back.views[0].size == (17, 12)
    (got,) = store.view_inputs(back)
    assert got.noise is not None
    assert (got.noise.a, got.noise.b, got.noise.source) == (1.5, 0.25, "capture.json")
    for _ in range(2):  # frames may be iterated again
        pairs = list(got.frames)
        assert [k for k, _ in pairs] == list(p.keys)
        for (_, a), (_, b) in zip(pairs, frames, strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)
    assert got.color is not None
    np.testing.assert_array_equal(got.color, color)


def test_files_follow_the_order_of_the_plan(tmp_path: Path) -> None:
    """The contract names white, black, frames and inverse apart; the plan interleaves them."""
    names = [f"{n}.png" for n in ("w", "b", "m0", "m1", "i0", "i1")]
    for i, n in enumerate(names):
        cv2.imwrite(str(tmp_path / n), np.full((4, 5), i, np.uint8))
    gray = {
        "gray": "v",
        "cell": 8.0,
        "frames": ["m0.png", "m1.png"],
        "inverse": ["i0.png", "i1.png"],
        "white": "w.png",
        "black": "b.png",
        "bits_total": 11,
    }
    write_doc(tmp_path, [gray])
    capture = store.read_capture(tmp_path)
    got = [(k.role, k.number, int(a[0, 0])) for k, a in store.view_inputs(capture)[0].frames]
    assert got == [
        (Role.WHITE, 0, 0),
        (Role.BLACK, 0, 1),
        (Role.BIT, 0, 2),
        (Role.INVERSE, 0, 4),
        (Role.BIT, 1, 3),
        (Role.INVERSE, 1, 5),
    ]
    assert capture.layout is Layout.GRID


def write_doc(folder: Path, sets: list[Any], fmt: str = "Mono8", **more: Any) -> None:
    doc = {
        "format": "fringescope-capture",
        "version": 1,
        "projector": {"width": 91, "height": 114},
        "views": [{"camera": "camera1", "pixel_format": fmt, "sets": sets, **more}],
    }
    (folder / "capture.json").write_text(json.dumps(doc))


def three(names: list[str]) -> list[Any]:
    return [{"cycles_per_pixel": [0.01, 0], "steps": 3, "frames": names}]


@pytest.mark.parametrize("byteorder", ["<", ">"])
@pytest.mark.parametrize("compression", [None, "zlib"])
def test_pages_of_a_tiff(tmp_path: Path, byteorder: Any, compression: Any) -> None:
    stack = RNG.integers(0, 1024, (5, 6, 7)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "s.tif", stack, byteorder=byteorder, photometric="minisblack", compression=compression)
    write_doc(tmp_path, three(["s.tif#4", "s.tif#0", "s.tif#2"]), "Mono10")
    got = [a for _, a in store.view_inputs(store.read_capture(tmp_path))[0].frames]
    np.testing.assert_array_equal(np.stack(got), stack[[4, 0, 2]])
    assert all(a.dtype.isnative for a in got)


def test_lzw_tiff(tmp_path: Path) -> None:
    stack = [RNG.integers(0, 256, (6, 7)).astype(np.uint8) for _ in range(3)]
    cv2.imwritemulti(str(tmp_path / "s.tif"), stack, [cv2.IMWRITE_TIFF_COMPRESSION, 5])
    write_doc(tmp_path, three(["s.tif#2", "s.tif#0", "s.tif#1"]))
    got = [a for _, a in store.view_inputs(store.read_capture(tmp_path))[0].frames]
    np.testing.assert_array_equal(np.stack(got), np.stack(stack)[[2, 0, 1]])


def test_grey_stored_as_three_channels(tmp_path: Path) -> None:
    grey = [RNG.integers(0, 256, (6, 7)).astype(np.uint8) for _ in range(3)]
    for i, g in enumerate(grey):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.repeat(g[..., None], 3, axis=2))
    write_doc(tmp_path, three(["0.png", "1.png", "2.png"]))
    for (_, a), g in zip(store.view_inputs(store.read_capture(tmp_path))[0].frames, grey, strict=True):
        np.testing.assert_array_equal(a, g)


def test_hash_of_a_capture_follows_content_not_layout(tmp_path: Path) -> None:
    p = plan()
    frames = frames_of(p)
    for name in ("a", "b", "c"):
        store.write_capture(tmp_path / name, 91, 114, Layout.GRID, [ViewInput(p, frames)])
    hashes = {n: store.hash_capture(store.read_capture(tmp_path / n)) for n in ("a", "b")}
    doc = json.loads((tmp_path / "b/capture.json").read_text())
    (tmp_path / "b/capture.json").write_text(json.dumps(dict(reversed(doc.items())), indent=7))
    assert hashes["a"] == hashes["b"] == store.hash_capture(store.read_capture(tmp_path / "b"))
    changed = frames[5][1].copy()
    changed[3, 4] ^= 1
    write_png(tmp_path / "c/camera1/05.png", changed)
    assert store.hash_capture(store.read_capture(tmp_path / "c")) != hashes["a"]


def test_noise_of_a_view_wins(tmp_path: Path) -> None:
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.zeros((4, 5), np.uint8))
    write_doc(tmp_path, three(["0.png", "1.png", "2.png"]))
    doc = json.loads((tmp_path / "capture.json").read_text())
    doc["noise"] = {"a": 4, "b": 0.5}
    (tmp_path / "capture.json").write_text(json.dumps(doc))
    noise = store.read_capture(tmp_path).views[0].noise
    assert noise is not None
    assert (noise.a, noise.b) == (4, 0.5)
    doc["views"][0]["noise"] = {"a": 1, "b": 0.0}
    (tmp_path / "capture.json").write_text(json.dumps(doc))
    noise = store.read_capture(tmp_path).views[0].noise
    assert noise is not None
    assert (noise.a, noise.b) == (1, 0)


def test_a_missing_or_doubled_frame_is_not_written(tmp_path: Path) -> None:
    p = plan()
    frames = frames_of(p)
    with pytest.raises(CaptureError, match="missing"):
        store.write_capture(tmp_path / "c", 91, 114, Layout.GRID, [ViewInput(p, frames[:-1])])
    with pytest.raises(CaptureError, match="twice"):
        store.write_capture(tmp_path / "c", 91, 114, Layout.GRID, [ViewInput(p, [*frames, frames[0]])])
    assert list(tmp_path.iterdir()) == []


@needs_shared
@pytest.mark.parametrize(
    ("name", "layout", "sizes", "frames"),
    [
        ("rendered-small/plane", Layout.GRID, [(684, 456)] * 3, 48),
        ("slstudio/skull", Layout.DIAMOND, [(1688, 1352)], 6),
        ("slstudio/skull-gray", Layout.DIAMOND, [(1688, 1352)], 12),
        ("gamma-mug/object2", Layout.GRID, [(1936, 1216)], 16),
    ],
)
def test_captures_of_others(name: str, layout: Layout, sizes: list[tuple[int, int]], frames: int) -> None:
    capture = store.read_capture(SHARED / name)
    assert capture.layout is layout
    assert [v.size for v in capture.views] == sizes
    assert sum(len(v.files) for v in capture.views) == frames
    key, frame = next(iter(store.view_inputs(capture)[0].frames))
    assert key == capture.views[0].plan.keys[0]
    expected = cv2.imread(str(SHARED / name / capture.views[0].files[0]), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(frame, expected)


@needs_shared
@pytest.mark.parametrize("name", ["rendered-small/truth/rig.json", "slstudio/rig-author.json"])
def test_rigs_of_others(name: str, tmp_path: Path) -> None:
    doc = json.loads((SHARED / name).read_text())
    rig = store.read_rig(SHARED / name)
    assert [c.name for c in rig.cameras] == [c["name"] for c in doc["cameras"]]
    np.testing.assert_array_equal(rig.cameras[0].lens.K, doc["cameras"][0]["K"])
    np.testing.assert_allclose(rig.projector.pose.R, doc["projector"]["R"], atol=1e-6)
    store.write_rig(tmp_path / "r.json", rig)
    again = store.read_rig(tmp_path / "r.json")
    np.testing.assert_allclose(again.cameras[0].pose.R, rig.cameras[0].pose.R, atol=1e-15)


# -------------------------------------------------------------------------------------------------------------- rigs


def device(**more: Any) -> dict[str, Any]:
    return {
        "width": 64,
        "height": 48,
        "K": [[100.0, 0, 31.5], [0, 100.0, 23.5], [0, 0, 1]],
        "distortion": [0.1, 0, 0, 0, 0],
        "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "t": [0, 0, 500.0],
        **more,
    }


def rig_doc() -> dict[str, Any]:
    return {
        "format": "fringescope-rig",
        "version": 1,
        "units": "mm",
        "projector": device(layout="diamond", serial="P1"),
        "cameras": [device(name="camera1", serial=12), device(name="camera2")],
        "board": {"square_mm": 5.0},
        "volume": {"center": [0, 0, 1], "axes": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "half_size": [50, 30, 20]},
    }


def test_a_rig_keeps_the_keys_that_it_does_not_know(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps(rig_doc()))
    rig = store.read_rig(tmp_path / "a.json")
    assert rig.projector.plane_size == (128, 48)
    assert rig.projector.lens.width == 128
    store.write_rig(tmp_path / "b.json", rig)
    assert json.loads((tmp_path / "b.json").read_text()) == rig_doc()
    assert store.hash_rig(tmp_path / "a.json") == store.hash_rig(tmp_path / "b.json")


def with_lens(path: Path, **camera: Any) -> Path:
    doc = rig_doc()
    doc["cameras"][1].update(camera)
    path.write_text(json.dumps(doc))
    return path


@pytest.mark.parametrize("where", [0.5, 0.97, 1.03])
@pytest.mark.parametrize("c", [(20.0, 30.0), (31.5, 23.5), (-15.0, 70.0)])
def test_a_lens_may_fold_beyond_its_picture_and_not_inside(tmp_path: Path, where: float, c: Any) -> None:
    """By hand: r + k1 r^3 turns back at r = 1 / sqrt(-3 k1), which it images at 2/3 of that."""
    far = max(np.hypot(x - c[0], y - c[1]) for x in (0, 63) for y in (0, 47))
    K = [[100.0, 0, c[0]], [0, 100.0, c[1]], [0, 0, 1]]
    k1 = -4 / 27 / (where * far / 100) ** 2
    path = with_lens(tmp_path / "a.json", K=K, distortion=[k1, 0, 0, 0, 0])
    if where > 1:
        store.read_rig(path)
        return
    with pytest.raises(RigError, match=r"camera 'camera2': distortion .*: folds at \(") as e:
        store.read_rig(path)
    u, v = map(int, re.findall(r"at \((\d+), (\d+)\)", str(e.value))[0])
    assert np.hypot(u - c[0], v - c[1]) == pytest.approx(where * far, abs=1.5)


@pytest.mark.parametrize("scale", [1.0, 0.125, 0.04])
@pytest.mark.parametrize("preset", presets.names())
def test_the_lenses_of_the_twin_pass(tmp_path: Path, preset: str, scale: float) -> None:
    for layout in Layout:
        store.write_rig(tmp_path / f"{layout.value}.json", presets.instrument(preset, scale, layout).rig)
        store.read_rig(tmp_path / f"{layout.value}.json")


@pytest.mark.parametrize("seed", range(4))
def test_lenses_are_refused_where_pixels_have_no_direction(tmp_path: Path, seed: int) -> None:
    """Of random lenses, those that fold have pixels that see nothing; gentle ones, which pass, have none."""
    rng = np.random.default_rng(seed)
    uv = np.stack(np.meshgrid(np.arange(64.0), np.arange(48.0)), -1)
    folded = 0
    for strength in np.repeat([0.01, 2.0], 15):
        K = np.array([[100.0, 0, rng.uniform(-20, 84)], [0, 100.0, rng.uniform(-20, 68)], [0, 0, 1]])
        d = strength * rng.normal(size=5) * [1, 1.5, 0.05, 0.05, 1]
        blind = bool(np.isnan(geometry.unproject(Lens(64, 48, K, d), uv)).any())
        path = with_lens(tmp_path / "a.json", K=K.tolist(), distortion=d.tolist())
        told = ""
        try:
            store.read_rig(path)
        except RigError as e:
            told = str(e)
        folded += "folds" in told
        assert blind or "folds" not in told
        assert not (blind or told) or strength > 1
    assert folded >= 3


@pytest.mark.parametrize(("what", "reader"), [("capture", store.read_capture), ("rig", store.read_rig)])
@pytest.mark.parametrize(("version", "says"), [(2, "higher"), *((v, "version") for v in (0, "1", None, True))])
def test_versions(tmp_path: Path, what: str, reader: Any, version: Any, says: str) -> None:
    path = tmp_path / "x.json"
    path.write_text(json.dumps({"format": f"fringescope-{what}", "version": version}))
    with pytest.raises(FormatError, match=says):
        reader(path)
    path.write_text(json.dumps({"format": "something", "version": 1}))
    with pytest.raises(FormatError, match="something"):
        reader(path)


@pytest.mark.parametrize(("what", "reader"), [
    ("capture", store.read_capture), ("rig", store.read_rig), ("scan", store.read_scan),
    ("response", store.read_response),
])  # fmt: skip
@pytest.mark.parametrize("key", ["format", "version"])
def test_a_missing_key_is_called_missing(tmp_path: Path, what: str, reader: Any, key: str) -> None:
    doc = {"format": f"fringescope-{what}", "version": 1}
    del doc[key]
    path = tmp_path / "x.json"
    path.write_text(json.dumps(doc))
    with pytest.raises(FormatError, match=f'x.json: "{key}" is missing; needed') as e:
        reader(path)
    assert "null" not in str(e.value)
    path.write_text(json.dumps(doc | {key: None}))
    with pytest.raises(FormatError, match=f'"{key}" is null; needed'):
        reader(path)


@pytest.mark.parametrize("key", ["files", "views"])
def test_a_scan_without_its_lists_says_which(tmp_path: Path, key: str) -> None:
    write_a_scan(tmp_path / "s")
    path = tmp_path / "s" / "scan.json"
    doc = json.loads(path.read_text())
    path.write_text(json.dumps(doc | {key: 7}))
    with pytest.raises(FormatError, match=f'"{key}" is 7; needed'):
        store.read_scan(tmp_path / "s")
    del doc[key]
    path.write_text(json.dumps(doc))
    with pytest.raises(FormatError, match=f'"{key}" is missing; needed'):
        store.read_scan(tmp_path / "s")


# -------------------------------------------------------------------------------------------------------------- scans


def a_scan() -> Scan:
    rng = np.random.default_rng(3)
    grids = []
    for i in range(2):
        xyz = rng.normal(size=(6, 9, 3)).astype(np.float32)
        reasons = np.zeros((6, 9), np.uint16)
        reasons[0] = Reason.NOT_LOCAL | Reason.DARK
        xyz[0] = np.nan
        sigma = rng.uniform(size=(6, 9)).astype(np.float32)
        grids.append(Grid(i, f"camera{i + 1}", xyz, sigma, reasons))
    n = 5
    cloud = Cloud(
        np.zeros((n, 3), np.float32),
        np.zeros((n, 3), np.float32),
        np.zeros((n, 3), np.uint8),
        np.zeros(n, np.float32),
        np.zeros(n, np.uint8),
    )
    verdict = ViewVerdict("camera1", 54, 45, {"dark or in shadow": 9}, ("all is well",))
    return Scan(tuple(grids), cloud, None, (verdict,), {"rms": np.float32(1.5), "bad": float("nan")})


def write_a_scan(folder: Path, pictures: tuple[Picture, ...] = (), **more: Any) -> dict[str, Any]:
    def ply(cloud: Cloud, path: Path) -> None:
        path.write_bytes(b"ply" + cloud.xyz.tobytes())

    def glb(*_: Any) -> None:
        raise AssertionError("there is no surface")

    return store.write_scan(
        folder,
        dataclasses.replace(a_scan(), pictures=pictures),
        settings={"phase": {"x": 1}},
        capture_hash="sha256:1",
        rig_hash="sha256:2",
        write_ply=ply,
        write_glb=glb,
        **more,
    )


def test_surface_and_preview_are_counted_and_listed(tmp_path: Path) -> None:
    def write(s: Surface, path: Path, extras: Any) -> None:
        path.write_text(f"{s.n_faces} {extras['scan']}")

    part = SurfacePart(0, np.arange(3, dtype=np.uint32), np.zeros((3, 2), np.float32), np.zeros((2, 3), np.uint32),
                       np.zeros((4, 4, 3), np.uint8))
    fine = Surface(np.zeros((3, 3), np.float32), np.zeros((3, 3), np.float32), (part, part))
    coarse = Surface(fine.vertices, fine.normals, (part,))
    doc = store.write_scan(
        tmp_path / "s", dataclasses.replace(a_scan(), surface=fine, preview=coarse), settings={},
        capture_hash="sha256:1", rig_hash="sha256:2", write_ply=lambda _, path: path.write_bytes(b"ply"),
        write_glb=write, write_preview=write,
    )  # fmt: skip
    assert (tmp_path / "s" / "surface.glb").read_text() == f"4 {doc['hash']}"
    assert (tmp_path / "s" / "preview.glb").read_text() == f"2 {doc['hash']}"
    assert {"surface.glb", "preview.glb"} <= set(doc["files"])
    assert doc["preview"] == {"vertices": 3, "triangles": 2}
    assert doc["surface"]["triangles"] == 4


@pytest.mark.parametrize("grids", [True, False])
def test_scan_comes_back(tmp_path: Path, grids: bool) -> None:
    doc = write_a_scan(tmp_path / "s", grids=grids)
    expected = a_scan()
    back = store.read_scan(tmp_path / "s")
    assert back.document == doc
    assert back.document["figures"] == {"rms": 1.5, "bad": None}
    assert back.document["views"][0]["lost"] == {"dark or in shadow": 9}
    for a, b in zip(back.grids, expected.grids, strict=True):
        assert (a.view, a.camera) == (b.view, b.camera)
        np.testing.assert_array_equal(a.xyz, b.xyz)
        np.testing.assert_array_equal(a.sigma, b.sigma)
        np.testing.assert_array_equal(a.reasons, b.reasons)
    if grids:
        reasons = cv2.imread(str(tmp_path / "s/camera2/reasons.png"), cv2.IMREAD_UNCHANGED)
        assert reasons.dtype == np.uint16
        assert reasons[0, 0] == 1025
        assert tifffile.imread(tmp_path / "s/camera2/xyz.tif").shape == (6, 9, 3)
    sha = hashlib.sha256((tmp_path / "s/cloud.ply").read_bytes()).hexdigest()
    assert doc["files"]["cloud.ply"] == f"sha256:{sha}"


@pytest.mark.parametrize("grids", [True, False])
def test_the_pictures_of_a_scan_come_back(tmp_path: Path, grids: bool) -> None:
    rng = np.random.default_rng(4)
    mosaic = Picture("camera1", rng.integers(0, 4096, (6, 9), np.uint16), PixelFormat.BAYER_RG12)
    colour = Picture("camera2", rng.integers(0, 256, (6, 9, 3), np.uint8), PixelFormat.RGB8, "projector")
    doc = write_a_scan(tmp_path / "s", (mosaic, colour), grids=grids, extra={"instrument": "sim://pair/plane"})
    file = "camera1/picture." + ("png" if grids else "npy")
    assert doc["views"][0]["picture"] == {"file": file, "pixel_format": "BayerRG12", "light": "ring"}
    assert file in doc["files"]
    back = store.read_scan(tmp_path / "s")
    assert back.instrument == "sim://pair/plane"
    for a, b in zip(back.every_picture(), (mosaic, colour), strict=True):
        assert (a.camera, a.pixel_format, a.light, a.frame.dtype) == (b.camera, b.pixel_format, b.light, b.frame.dtype)
        np.testing.assert_array_equal(a.frame, b.frame)


@pytest.mark.parametrize(
    ("told", "why"),
    [
        ({"file": "camera1/picture.npy", "pixel_format": "Mono9", "light": "ring"}, "needed file, pixel_format"),
        ({"file": "camera1/picture.npy", "pixel_format": "Mono12", "light": "ring"}, "missing or broken"),
        ({"file": "camera1/none.npy", "pixel_format": "Mono8", "light": "ring"}, "missing or broken"),
        ({"file": "../picture.npy", "pixel_format": "Mono8", "light": "ring"}, "picture"),
        ({"file": "camera1/picture.npy", "pixel_format": "Mono8", "light": "moon"}, "needed ring or projector"),
        ({"file": "camera1/xyz.npy", "pixel_format": "Mono8", "light": "ring"}, "needs"),
        ([1], "needed file"),
    ],
)
def test_pictures_that_are_not_what_scan_json_says(tmp_path: Path, told: Any, why: str) -> None:
    write_a_scan(tmp_path / "s", (Picture("camera1", np.ones((6, 9), np.uint8), PixelFormat.MONO8),))
    doc = json.loads((tmp_path / "s/scan.json").read_text())
    doc["views"][0]["picture"] = told
    (tmp_path / "s/scan.json").write_text(json.dumps(doc))
    with pytest.raises(FormatError, match=why):
        store.read_scan(tmp_path / "s")


def test_a_scan_without_pictures_says_to_reconstruct_again(tmp_path: Path) -> None:
    write_a_scan(tmp_path / "s")
    back = store.read_scan(tmp_path / "s")
    assert back.pictures == (None, None)
    assert back.instrument is None
    with pytest.raises(FormatError, match="no picture of camera1, camera2; reconstruct it again"):
        back.every_picture()
    assert store.read_scan(tmp_path / "s", grids=False).pictures == ()


def test_times_of_a_scan_stand_beside_its_figures(tmp_path: Path) -> None:
    timed = dataclasses.replace(a_scan(), figures={"rms": 1.5, "times_s": {"fuse": np.float64(0.25)}})
    doc = store.write_scan(
        tmp_path / "s", timed, settings={}, capture_hash="sha256:1", rig_hash="sha256:2",
        write_ply=lambda _, path: path.write_bytes(b"ply"), write_glb=lambda *_: None,
    )  # fmt: skip
    assert (doc["times_s"], doc["figures"]) == ({"fuse": 0.25}, {"rms": 1.5})


def test_a_scan_that_changed_is_refused(tmp_path: Path) -> None:
    write_a_scan(tmp_path / "s")
    with (tmp_path / "s/cloud.ply").open("ab") as f:
        f.write(b"x")
    with pytest.raises(FormatError, match="changed"):
        store.read_scan(tmp_path / "s")
    (tmp_path / "s/cloud.ply").unlink()
    with pytest.raises(FormatError, match="missing"):
        store.read_scan(tmp_path / "s")


def test_decoded_folder(tmp_path: Path) -> None:
    phase = np.linspace(0, 40, 63, dtype=np.float32).reshape(7, 9)
    phase[0, 0] = np.nan
    flat = np.ones((7, 9), np.float32)
    reasons = np.zeros((7, 9), np.uint16)
    reasons[0, 0] = Reason.DARK | Reason.LOW_MODULATION
    d = Decoded(
        "camera1",
        (Direction((0.01, 0), phase, flat, flat), Direction((0, 0.01), phase, flat, flat)),
        (),
        (),
        flat,
        flat,
        reasons,
        NoiseModel(1, 0),
    )
    blank = np.zeros((7, 9, 3), np.uint8)
    doc = store.write_decoded(
        tmp_path / "d", [(d, flat, flat)], settings={}, capture_hash="sha256:0", pictures=lambda _: {"a": blank}
    )
    names = {p.name for p in (tmp_path / "d/camera1").iterdir() if not p.name.startswith("preview")}
    assert names == {"phase_0.tif", "phase_1.tif", "modulation.tif", "background.tif", "u.tif", "v.tif", "reasons.png"}
    assert (tmp_path / "d/camera1/preview-a.png").is_file()
    got = tifffile.imread(tmp_path / "d/camera1/phase_1.tif")
    assert got.dtype == np.float32
    np.testing.assert_array_equal(got, phase)
    assert doc["views"][0]["lost"] == {"dark or in shadow": 1, "low modulation": 1}


# -------------------------------------------------------------------------------------------- whole or not at all


def test_a_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "er" / "out"

    def fail() -> None:
        with store.new_folder(target, marker="scan.json") as tmp:
            (tmp / "a").write_text("half")
            assert not target.exists()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert list(tmp_path.iterdir()) == []
    with store.new_folder(target, marker="scan.json") as tmp:
        (tmp / "scan.json").write_text("{}")
    assert [p.name for p in target.iterdir()] == ["scan.json"]
    assert [p.name for p in target.parent.iterdir()] == ["out"]


def test_force_replaces_only_its_own_kind_and_only_at_the_end(tmp_path: Path) -> None:
    target = tmp_path / "out"
    target.mkdir()  # empty: allowed
    with store.new_folder(target, marker="scan.json") as tmp:
        (tmp / "scan.json").write_text("first")
    with pytest.raises(OutputError, match="already holds a scan"), store.new_folder(target, marker="scan.json"):
        pass
    with (
        pytest.raises(OutputError, match="holds other files"),
        store.new_folder(target, marker="capture.json", force=True),
    ):
        pass

    def fail() -> None:
        with store.new_folder(target, marker="scan.json", force=True) as tmp:
            (tmp / "scan.json").write_text("second")
            raise ValueError("a bug")

    with pytest.raises(ValueError, match="a bug"):
        fail()
    assert (target / "scan.json").read_text() == "first"
    with store.new_folder(target, marker="scan.json", force=True) as tmp:
        (tmp / "scan.json").write_text("second")
        assert (target / "scan.json").read_text() == "first"
    assert (target / "scan.json").read_text() == "second"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


KILLED = """
import os, signal, sys
from fringescope import store
def folder(path):
    with store.new_folder(path, marker="scan.json", force=True) as tmp:
        (tmp / "a").write_text("half")
        wait()
def file(path):
    with store.new_file(path, force=True) as tmp:
        tmp.write_text("half")
        wait()
def wait():
    print("ready", flush=True)
    sys.stdin.read()
{"folder": folder, "file": file}[sys.argv[1]](sys.argv[2])
"""


def begin(kind: str, target: Path) -> subprocess.Popen[str]:
    """A process that is in the midst of writing."""
    command = [sys.executable, "-c", KILLED, kind, str(target)]
    run = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert run.stdout is not None
    assert run.stdout.readline().strip() == "ready"
    return run


def kill(run: subprocess.Popen[str]) -> None:
    run.kill()
    run.communicate()


def age(folder: Path, to: float = 0.0) -> None:
    for p in folder.iterdir():
        if p.name.startswith("."):
            os.utime(p, (to, to))


@pytest.mark.skipif(os.name != "posix", reason="no locks that end with their process here")
def test_what_a_killed_run_left_goes_with_the_next(tmp_path: Path) -> None:
    target, kept = tmp_path / "out", tmp_path / "out.other"
    dead, live, other = begin("folder", target), begin("folder", target), begin("folder", kept)
    try:
        kill(dead)
        kill(other)
        assert len([p for p in tmp_path.iterdir() if p.suffix == ".part"]) == 3
        age(tmp_path, time.time())
        with store.new_folder(target, marker="scan.json") as tmp:
            (tmp / "scan.json").write_text("{}")
        left = [p for p in tmp_path.iterdir() if p.suffix == ".part"]
        assert len(left) == 3  # too young to be sure
        age(tmp_path)
        with store.new_folder(target, marker="scan.json", force=True) as tmp:
            (tmp / "scan.json").write_text("{}")
        left = [p for p in tmp_path.iterdir() if p.suffix == ".part"]
        assert len(left) == 2  # the one that still runs, and that of another target
        assert [p for p in left if p.name.startswith(".out.other.")]
    finally:
        kill(live)
    age(tmp_path)
    with store.new_folder(target, marker="scan.json", force=True) as tmp:
        (tmp / "scan.json").write_text("{}")
    assert len([p for p in tmp_path.iterdir() if p.suffix == ".part"]) == 1


@pytest.mark.skipif(os.name != "posix", reason="no locks that end with their process here")
def test_what_a_killed_run_left_of_a_file_goes_with_the_next(tmp_path: Path) -> None:
    target = tmp_path / "rig.json"
    kill(begin("file", target))
    live = begin("file", target)
    try:
        age(tmp_path)
        with store.new_file(target) as tmp:
            tmp.write_text("{}")
        assert len(list(tmp_path.iterdir())) == 2
    finally:
        kill(live)
    age(tmp_path)
    with store.new_file(target, force=True) as tmp:
        tmp.write_text("{}")
    assert [p.name for p in tmp_path.iterdir()] == ["rig.json"]


@pytest.mark.skipif(os.name != "posix", reason="no locks that end with their process here")
def test_a_folder_that_a_killed_run_had_set_aside_comes_back(tmp_path: Path) -> None:
    target, aside = tmp_path / "out", tmp_path / ".out.abcd1234.old"
    (aside / "was").mkdir(parents=True)
    (aside / "was" / "scan.json").write_text("first")
    age(tmp_path)
    with pytest.raises(OutputError, match="already holds a scan"), store.new_folder(target, marker="scan.json"):
        pass
    assert (target / "scan.json").read_text() == "first"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_files_appear_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    with store.new_file(path) as tmp:
        tmp.write_text("first")
    with pytest.raises(OutputError, match="exists"), store.new_file(path):
        pass

    def fail() -> None:
        with store.new_file(path, force=True) as tmp:
            tmp.write_text("half")
            raise OSError(28, "No space left on device")

    with pytest.raises(OutputError, match="disk is full"):
        fail()
    assert path.read_text() == "first"
    assert [p.name for p in tmp_path.iterdir()] == ["r.json"]
    with pytest.raises(OutputError, match="folder"), store.new_file(tmp_path, force=True):
        pass


# ------------------------------------------------------------------------------------------------------------ pictures


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.booleans())
def test_every_truncation_and_most_damage_of_a_png_is_found(at: int, cut: bool) -> None:
    """No prefix of a PNG passes, and no flipped bit does: libpng alone forgives both."""
    image = np.random.default_rng(0).integers(0, 256, (30, 40)).astype(np.uint8)
    data = bytearray(cv2.imencode(".png", image)[1].tobytes())
    at %= len(data)
    if cut:
        data = data[:at]
    else:
        data[at] ^= 0x10
    if not data.startswith(b"\x89PNG\r\n\x1a\n"):
        return
    with pytest.raises(CaptureError):
        decode_png(bytes(data), Path("x.png"))


def test_rgb_order(tmp_path: Path) -> None:
    rgb = np.zeros((4, 5, 3), np.uint8)
    rgb[..., 0] = 200
    write_png(tmp_path / "a.png", rgb)
    np.testing.assert_array_equal(Images(tmp_path).frame("a.png", PixelFormat.RGB8), rgb)
    assert cv2.imread(str(tmp_path / "a.png"))[0, 0].tolist() == [0, 0, 200]
    tifffile.imwrite(tmp_path / "a.tif", rgb, photometric="rgb")
    np.testing.assert_array_equal(Images(tmp_path).frame("a.tif", PixelFormat.RGB8), rgb)


def test_singular_and_not_finite_rigs(tmp_path: Path) -> None:
    for change, says in (
        ({"K": [[0, 0, 1], [0, 0, 1], [0, 0, 1]]}, "positive"),
        ({"K": [[float("nan"), 0, 1], [0, 1, 1], [0, 0, 1]]}, "NaN"),
        ({"R": [[1, 0, 0], [0, 1, 0], [0, 0, 0]]}, "rotation"),
        ({"t": [0, 0]}, "shape"),
        ({"K": [[1, 2], [3]]}, "numbers"),
    ):
        doc = rig_doc()
        doc["cameras"][1].update(change)
        (tmp_path / "a.json").write_text(json.dumps(doc))
        with pytest.raises(RigError, match=f"camera 'camera2'.*{says}"):
            store.read_rig(tmp_path / "a.json")


# ------------------------------------------------------------------------------------------------------------- spool


def test_a_spool_gives_frames_and_rows_as_they_came(rng):
    from fringescope.store.spool import Spool, spooled
    from fringescope.types import RowFrames

    shapes = [(7, 5, 3), (7, 5), (7, 5), (7, 5)]
    keys = [FrameKey(0, Role.STEP, n) for n in range(4)]
    frames = [(k, rng.integers(0, 60000, shape, dtype=np.uint16)) for k, shape in zip(keys, shapes, strict=True)]
    spool = Spool(iter(frames))
    assert isinstance(spool, RowFrames)
    for _ in range(2):
        for (key, a), (want, b) in zip(spool, frames, strict=True):
            assert key == want
            np.testing.assert_array_equal(a, b)
    for (key, a), (want, b) in zip(spool.rows(2, 5), frames, strict=True):
        assert key == want
        np.testing.assert_array_equal(a, b[2:5])
    assert [a.shape[0] for _, a in spool.rows(5, 99)] == [2] * 4
    assert spooled(frames, 1000) is frames
    assert isinstance(spooled(frames, 1 << 30), Spool)


def test_a_full_disk_under_the_spool_is_said(monkeypatch, rng):
    import tempfile

    from fringescope.store import spool

    class Full:
        def write(self, _data):
            raise OSError(28, "No space left on device")

        def close(self):
            pass

    monkeypatch.setattr(tempfile, "TemporaryFile", Full)
    frame = rng.integers(0, 255, (7, 5), dtype=np.uint8)
    with pytest.raises(OutputError, match="No space left on device"):
        spool.Spool([(FrameKey(0, Role.STEP, 0), frame)])
