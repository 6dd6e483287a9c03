"""Packed surfaces, unpacked by meshoptimizer's own decoder as viewers do, are the plain ones within what is stated."""

import base64
import json
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fringescope import export
from fringescope.errors import OutputError
from fringescope.types import Surface, SurfacePart

needs_packer = pytest.mark.skipif(not export.can_pack(), reason="needs fringescope[meshopt]")
pytestmark = needs_packer


def height(x, y):
    return 4 * np.sin(x / 9) * np.cos(y / 7)


def sheet(n=60, parts=3):
    """A wavy sheet of 90 mm, cut into strips that share their borders, each with a picture of its own."""
    y, x = (a.ravel().astype(np.float64) * 90 / (n - 1) for a in np.mgrid[:n, :n])
    vertices = np.stack([x - 20, y + 300, height(x, y)], 1).astype(np.float32)
    quads = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate(
        [np.stack([quads, quads + 1, quads + n], 1), np.stack([quads + 1, quads + n + 1, quads + n], 1)]
    )
    strip = np.minimum((faces[:, 0] % n) * parts // (n - 1), parts - 1)
    v, u = np.mgrid[:240, :360]
    picture = np.stack([u % 256, v % 256, (u * v) % 251], -1).astype(np.uint8)
    made = []
    for i in range(parts):
        used, local = np.unique(faces[strip == i], return_inverse=True)
        uv = np.stack([x[used], y[used]], 1).astype(np.float32) / 90
        made.append(
            SurfacePart(i, used.astype(np.uint32), uv, local.reshape(-1, 3).astype(np.uint32), np.roll(picture, i, 0))
        )
    return Surface(vertices, np.tile(np.float32([0, 0, 1]), (len(vertices), 1)), tuple(made))


def pictures(s):
    return [export.encode_picture(p.texture, 85) for p in s.parts]


def unpacked(data, reader, tmp_path):
    """Views, places (mm), texture coordinates and triangles, as the outside decoder tells them."""
    (tmp_path / "s.glb").write_bytes(data)
    done = subprocess.run([*reader, str(tmp_path / "s.glb")], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    out = []
    for p in json.loads(done.stdout):
        xyz, uv = (np.frombuffer(base64.b64decode(p[k]), np.float64) for k in ("places", "uv"))
        faces = np.frombuffer(base64.b64decode(p["indices"]), np.uint32)
        out.append((p["view"], xyz.reshape(-1, 3), uv.reshape(-1, 2), faces.reshape(-1, 3)))
    return out


def document(data):
    return json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])


def turned(faces):
    """Triangles with their lowest corner first, still the same way round, in one order."""
    first = faces.argmin(axis=1)
    rolled = np.stack([faces[np.arange(len(faces)), (first + k) % 3] for k in range(3)], 1)
    return rolled[np.lexsort(rolled.T[::-1])]


@pytest.mark.parametrize("n", [60, 280])  # indices of 16 bits, and of 32
def test_what_a_viewer_unpacks_is_the_plain_surface(n, meshopt_reader, tmp_path):
    s = sheet(n, 1 if n > 100 else 3)
    data = export.packed_bytes(s, pictures(s))
    step = 1e-3 * document(data)["asset"]["extras"]["step_um"]
    assert step == pytest.approx(90 / 65535, rel=1e-3)  # 1.4 um over 90 mm
    for (view, xyz, uv, faces), part in zip(unpacked(data, meshopt_reader, tmp_path), s.parts, strict=True):
        assert view == part.view
        wanted = s.vertices[part.vertex_index].astype(np.float64)
        assert len(xyz) == len(wanted)
        _, at = cKDTree(wanted).query(xyz)
        assert len(set(at.tolist())) == len(wanted)  # each once
        assert np.abs(xyz - wanted[at]).max() <= 0.5001 * step + 1e-9
        assert np.abs(uv - part.uv[at]).max() <= 0.5001 / 65535 + 1e-7
        np.testing.assert_array_equal(turned(at[faces]), turned(part.faces))


def test_the_comparison_can_fail(meshopt_reader, tmp_path):
    s = sheet()
    data = bytearray(export.packed_bytes(s, pictures(s)))
    doc = document(bytes(data))
    begin = data.index(b"BIN\0") + 4 + doc["bufferViews"][0]["extensions"]["EXT_meshopt_compression"]["byteOffset"]
    data[begin] ^= 0xFF
    (tmp_path / "s.glb").write_bytes(data)
    done = subprocess.run([*meshopt_reader, str(tmp_path / "s.glb")], capture_output=True, timeout=60, check=False)
    assert done.returncode != 0


def test_khronos_finds_nothing_wrong(gltf_validator, tmp_path):
    s = sheet()
    for data in (export.packed_bytes(s, pictures(s), {"scan": "sha256:0"}), export.coarse_bytes(s, 1000, 30_000)):
        (tmp_path / "s.glb").write_bytes(data)
        done = subprocess.run([*gltf_validator, str(tmp_path / "s.glb")], capture_output=True, text=True, check=True)
        report = json.loads(done.stdout)
        assert (report["issues"]["numErrors"], report["issues"]["numWarnings"]) == (0, 0), report["issues"]["messages"]
        assert report["info"]["extensionsRequired"] == ["EXT_meshopt_compression", "KHR_mesh_quantization"]
        assert report["info"]["totalTriangleCount"] == document(data)["asset"]["extras"]["triangles"]
    assert document(export.packed_bytes(s, pictures(s), {"scan": "sha256:0"}))["asset"]["extras"]["scan"] == "sha256:0"


def borders(part):
    """Edges with a triangle on one side only, by the vertices of the surface."""
    edges = np.sort(part.vertex_index[part.faces[:, [0, 1, 1, 2, 2, 0]]].reshape(-1, 2), axis=1)
    edge, count = np.unique(edges, axis=0, return_counts=True)
    return {tuple(e) for e in edge[count == 1].tolist()}


def test_fewer_triangles_lie_on_the_same_surface_and_leave_no_gap():
    s = sheet(120)
    few = export.thinned(s, 6000)
    assert 5000 < few.n_faces <= 6000 < s.n_faces
    for before, after in zip(s.parts, few.parts, strict=True):
        assert borders(before) == borders(after)
        xyz = few.vertices[after.vertex_index][after.faces].astype(np.float64).mean(axis=1)
        off = np.abs(xyz[:, 2] - height(xyz[:, 0] + 20, xyz[:, 1] - 300))
        assert off.max() < 0.1  # mm: a triangle of side 2.5 on a bend of 0.13 / mm misses it by 0.13 * 2.5^2 / 8
        np.testing.assert_allclose(after.uv * 90, few.vertices[after.vertex_index][:, :2] - [-20, 300], atol=1e-4)
    assert export.thinned(s, s.n_faces) is s


def test_the_level_that_shows_first_is_as_small_as_was_asked():
    s = sheet(120)
    for most in (150_000, 60_000):
        data = export.coarse_bytes(s, 6000, most)
        assert len(data) <= most
    assert len(data) > 25_000  # no more is taken away than needed


def test_without_the_packer_it_says_so(monkeypatch):
    monkeypatch.setitem(sys.modules, "meshoptimizer", None)
    assert not export.can_pack()
    with pytest.raises(OutputError, match="pip install"):
        export.packed_bytes(sheet(), pictures(sheet()))


def test_a_surface_without_triangles():
    s = sheet()
    none = Surface(s.vertices, s.normals, ())
    with pytest.raises(OutputError, match="without triangles"):
        export.packed_bytes(none, [])
