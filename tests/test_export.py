"""What we write is read back by others' rules: PLY by our reader and by hand, GLB by Khronos' validator."""

import dataclasses
import io
import json
import shutil
import struct
import subprocess
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fringescope import export
from fringescope.errors import FormatError, OutputError
from fringescope.export.others import _paged
from fringescope.types import Cloud, Surface, SurfacePart

VALIDATOR = Path(__file__).parent / "glb_validator"


def cloud(n=50, seed=0):
    rng = np.random.default_rng(seed)
    normals = rng.standard_normal((n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Cloud(
        rng.standard_normal((n, 3)).astype(np.float32) * 30,
        normals.astype(np.float32),
        rng.integers(0, 256, (n, 3)).astype(np.uint8),
        rng.random(n).astype(np.float32),
        rng.integers(0, 3, n).astype(np.uint8),
    )


def surface(n=12, parts=2):
    """A wavy sheet, each part textured by its own picture: red grows with x, green with y."""
    y, x = np.mgrid[:n, :n].astype(np.float32)
    vertices = np.stack([x.ravel() * 2, y.ravel() * 2, np.sin(x.ravel() / 2)], 1).astype(np.float32)
    normals = np.stack([-np.cos(x.ravel() / 2) / 4, 0 * x.ravel(), 1 + 0 * x.ravel()], 1)
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    quads = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate(
        [np.stack([quads, quads + 1, quads + n], 1), np.stack([quads + 1, quads + n + 1, quads + n], 1)]
    )
    v, u = np.mgrid[:40, :60]
    texture = np.stack([u * 4, v * 6, 0 * u + 90], -1).astype(np.uint8)
    made = []
    for i in range(parts):
        mine = faces[i::parts]
        used, local = np.unique(mine, return_inverse=True)
        uv = (vertices[used, :2] / (2 * (n - 1)) * [59, 39] + 0.5) / [60, 40]
        made.append(
            SurfacePart(
                i, used.astype(np.uint32), uv.astype(np.float32), local.reshape(-1, 3).astype(np.uint32), texture
            )
        )
    return Surface(vertices, normals, tuple(made))


# ---------------------------------------------------------------------------------------------------------------- PLY


def test_ply_has_exactly_the_layout_of_the_contract(tmp_path):
    c = cloud(3)
    export.write_ply(c, tmp_path / "c.ply", "made\nby a test")
    raw = (tmp_path / "c.ply").read_bytes()
    head, body = raw.split(b"end_header\n", 1)
    assert head.decode().splitlines() == [
        "ply",
        "format binary_little_endian 1.0",
        "comment made by a test",
        "element vertex 3",
        *(f"property float {k}" for k in ("x", "y", "z", "nx", "ny", "nz")),
        *(f"property uchar {k}" for k in ("red", "green", "blue")),
        "property float sigma",
        "property uchar view",
    ]
    assert len(body) == 3 * 32
    for i in range(3):
        one = struct.unpack("<6f3BfB", body[32 * i : 32 * (i + 1)])
        np.testing.assert_array_equal(np.float32(one[:3]), c.xyz[i])
        assert list(one[6:9]) == c.rgb[i].tolist()
        assert one[10] == c.view[i]
        assert np.float32(one[9]) == c.sigma[i]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 300), st.integers(0, 1000))
def test_ply_comes_back_bit_for_bit(tmp_path_factory, n, seed):
    path = tmp_path_factory.mktemp("ply") / "c.ply"
    c = cloud(n, seed)
    export.write_ply(c, path)
    back = export.read_ply(path)
    for name in ("xyz", "normals", "rgb", "sigma", "view"):
        np.testing.assert_array_equal(getattr(back, name), getattr(c, name))
        assert getattr(back, name).dtype == getattr(c, name).dtype


def test_ply_of_others_with_fewer_and_stranger_properties(tmp_path):
    body = np.zeros(4, [("z", "<f8"), ("y", "<f4"), ("x", "<f4"), ("quality", "<i2")])
    body["x"], body["y"], body["z"] = 1, 2, 3
    path = tmp_path / "o.ply"
    path.write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty double z\n"
        b"property float y\nproperty float x\n"
        b"property short quality\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n" + body.tobytes()
    )
    c = export.read_ply(path)
    np.testing.assert_array_equal(c.xyz, np.tile(np.float32([1, 2, 3]), (4, 1)))
    assert np.isnan(c.sigma).all()


GOOD = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\n"
GOOD += b"property float y\nproperty float z\nend_header\n"


@pytest.mark.parametrize(
    ("raw", "why"),
    [
        (b"", "not a PLY"),
        (b"glTF....", "not a PLY"),
        (b"ply\n" + b"comment x\n" * 3, "without 'end_header'"),
        (GOOD.replace(b"binary_little_endian", b"ascii"), "binary little-endian"),
        (GOOD + b"\0" * 11, "truncated"),
        (GOOD.replace(b"float y", b"float x"), "each property once"),
        (GOOD.replace(b"float y", b"quaternion y"), "does not|not one that"),
        (GOOD.replace(b"vertex 1", b"vertex many"), "not one that"),
        (GOOD.replace(b"vertex", b"face"), "before the vertices"),
        (b"ply\n" + b"c" * 200_000, "without 'end_header'|not one that"),
    ],
)
def test_bad_ply_is_named(tmp_path, raw, why):
    path = tmp_path / "bad.ply"
    path.write_bytes(raw)
    with pytest.raises(FormatError, match=why) as e:
        export.read_ply(path)
    assert "\n" not in str(e.value)


# ---------------------------------------------------------------------------------------------------------------- GLB


def chunks(raw):
    magic, version, size = struct.unpack_from("<4sII", raw)
    assert (magic, version, size) == (b"glTF", 2, len(raw))
    n, kind = struct.unpack_from("<I4s", raw, 12)
    assert kind == b"JSON"
    m, kind = struct.unpack_from("<I4s", raw, 20 + n)
    assert kind == b"BIN\0"
    assert 28 + n + m == size
    return json.loads(raw[20 : 20 + n]), raw[28 + n :]


def test_glb_keeps_millimetres_under_a_root_that_makes_metres_and_y_up():
    s = surface()
    root, data = chunks(export.glb_bytes(s, {"scan": "sha256:12"}))
    assert root["asset"]["extras"] == {"units": "mm", "up": "z", "scan": "sha256:12"}
    (node,) = root["nodes"]
    x, y, z, w = node["rotation"]
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    np.testing.assert_allclose(R @ [0, 0, 1], [0, 1, 0], atol=1e-7)
    np.testing.assert_allclose(R @ [1, 0, 0], [1, 0, 0], atol=1e-7)
    assert node["scale"] == [0.001] * 3
    for part, primitive in zip(s.parts, root["meshes"][0]["primitives"], strict=True):
        a = root["accessors"][primitive["attributes"]["POSITION"]]
        view = root["bufferViews"][a["bufferView"]]
        xyz = np.frombuffer(data, "<f4", 3 * a["count"], view["byteOffset"]).reshape(-1, 3)
        np.testing.assert_array_equal(xyz, s.vertices[part.vertex_index])
        assert a["min"] == xyz.min(0).tolist()
    image = root["bufferViews"][root["images"][0]["bufferView"]]
    jpeg = np.frombuffer(data, np.uint8, image["byteLength"], image["byteOffset"])
    picture = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(picture.astype(int) - s.parts[0].texture).mean() < 4


def test_glb_with_png_keeps_every_code_and_large_parts_get_wide_indices():
    root, data = chunks(export.glb_bytes(surface(260, 1), quality=101, lit=True))
    assert "extensionsUsed" not in root
    image = root["bufferViews"][root["images"][0]["bufferView"]]
    png = cv2.imdecode(np.frombuffer(data, np.uint8, image["byteLength"], image["byteOffset"]), cv2.IMREAD_COLOR)[
        ..., ::-1
    ]
    np.testing.assert_array_equal(png, surface().parts[0].texture)
    assert root["accessors"][root["meshes"][0]["primitives"][0]["indices"]]["componentType"] == 5125


def test_a_surface_without_triangles_is_refused():
    s = surface()
    bare = Surface(s.vertices, s.normals, ())
    for write in (export.glb_bytes, export.viewer_page):
        with pytest.raises(OutputError, match="without triangles"):
            write(bare)
    with pytest.raises(OutputError, match="without triangles"):
        export.write_stl(bare, io.BytesIO())


@pytest.fixture(scope="session")
def validator():
    """Khronos' validator: a Node package, installed beside its script by `npm ci` where there is Node."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("node and npm are not installed: Khronos' GLB validator cannot run")
    if not (VALIDATOR / "node_modules" / "gltf-validator").is_dir():
        done = subprocess.run(
            ["npm", "ci", "--no-fund", "--no-audit"],
            cwd=VALIDATOR,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        if done.returncode:
            pytest.skip(f"gltf-validator could not be installed: {done.stderr.strip().splitlines()[-1:]}")

    def judge(path):
        done = subprocess.run(
            ["node", str(VALIDATOR / "validate.mjs"), str(path)],
            capture_output=True,
            text=True,
            timeout=120,
            check=True,
        )
        return json.loads(done.stdout)

    return judge


@pytest.mark.parametrize("n", [2, 13, 270])
def test_khronos_validator_has_no_word_to_say(validator, tmp_path, n):
    export.write_glb(surface(n), tmp_path / "s.glb", {"scan": "sha256:0"})
    report = validator(tmp_path / "s.glb")
    assert report["issues"]["numErrors"] == 0, report["issues"]["messages"][:3]
    assert report["issues"]["numWarnings"] == 0, report["issues"]["messages"][:3]
    assert report["info"]["totalTriangleCount"] == 2 * (n - 1) ** 2


def test_a_preview_keeps_within_its_bytes_and_the_validator_is_content(validator, tmp_path):
    s = surface(60)
    noise = np.random.default_rng(0).integers(0, 255, (400, 600, 3), np.uint8)
    s = dataclasses.replace(s, parts=tuple(dataclasses.replace(p, texture=noise) for p in s.parts))
    sizes = []
    for most in (10_000_000, 300_000, 170_000):
        export.write_preview(s, tmp_path / "p.glb", {"scan": "sha256:0"}, most)
        sizes.append((tmp_path / "p.glb").stat().st_size)
        assert sizes[-1] <= most
        report = validator(tmp_path / "p.glb")
        assert report["issues"]["numErrors"] == 0, report["issues"]["messages"][:3]
        assert report["info"]["totalTriangleCount"] == s.n_faces
    assert sizes[0] > sizes[1] > sizes[2] > 75_000


def test_khronos_validator_does_find_errors(validator, tmp_path):
    raw = export.glb_bytes(surface()).replace(b'"VEC2"', b'"VEC3"')
    (tmp_path / "bad.glb").write_bytes(raw)
    assert validator(tmp_path / "bad.glb")["issues"]["numErrors"] > 0


# ------------------------------------------------------------------------------------------------------ other formats


def test_stl_has_every_triangle_with_its_normal():
    s, f = surface(), io.BytesIO()
    export.write_stl(s, f)
    raw = f.getvalue()
    (count,) = struct.unpack_from("<I", raw, 80)
    assert count == s.n_faces
    assert len(raw) == 84 + 50 * count
    for i in (0, count - 1):
        n, corner = np.frombuffer(raw, "<f4", 3, 84 + 50 * i), np.frombuffer(raw, "<f4", 9, 96 + 50 * i).reshape(3, 3)
        want = np.cross(corner[1] - corner[0], corner[2] - corner[0])
        np.testing.assert_allclose(n, want / np.linalg.norm(want), atol=1e-6)


def test_obj_names_its_pictures_and_counts_its_vertices(tmp_path):
    s = surface()
    files = export.write_obj(s, tmp_path / "s.obj")
    assert [p.name for p in files] == ["s.obj", "s.mtl", "s_view0.jpg", "s_view1.jpg"]
    lines = files[0].read_text().splitlines()
    v = np.array([[float(x) for x in w.split()[1:]] for w in lines if w.startswith("v ")])
    np.testing.assert_allclose(v, s.vertices, atol=1e-4)
    vt = [w for w in lines if w.startswith("vt ")]
    assert len(vt) == sum(len(p.uv) for p in s.parts)
    corners = [c.split("/") for w in lines if w.startswith("f ") for c in w.split()[1:]]
    assert len(corners) == 3 * s.n_faces
    assert max(int(c[1]) for c in corners) == len(vt)
    uv = np.array([[float(x) for x in w.split()[1:]] for w in vt])
    np.testing.assert_allclose(uv[: len(s.parts[0].uv), 1], 1 - s.parts[0].uv[:, 1], atol=1e-6)
    assert "map_Kd s_view0.jpg" in files[1].read_text()
    assert files[2].read_bytes()[:2] == b"\xff\xd8"


def test_pcd_header_describes_its_body():
    c, f = cloud(7), io.BytesIO()
    export.write_pcd(c, f)
    head, body = f.getvalue().split(b"DATA binary\n")
    fields = dict(w.split(" ", 1) for w in head.decode().splitlines() if not w.startswith("#"))
    assert sum(map(int, fields["SIZE"].split())) * 7 == len(body)
    first = struct.unpack_from("<3fI3ffB", body)
    np.testing.assert_array_equal(np.float32(first[:3]), c.xyz[0])
    assert first[3] == int("{:02x}{:02x}{:02x}".format(*c.rgb[0]), 16)


def test_3mf_is_a_package_with_the_same_mesh():
    s, f = surface(), io.BytesIO()
    export.write_3mf(s, f)
    with zipfile.ZipFile(f) as z:
        assert {"[Content_Types].xml", "_rels/.rels", "3D/3dmodel.model"} == set(z.namelist())
        root = ElementTree.fromstring(z.read("3D/3dmodel.model"))
    assert root.attrib["unit"] == "millimeter"
    ns = "{http://schemas.microsoft.com/3dmanufacturing/core/2015/02}"
    assert len(root.findall(f".//{ns}vertex")) == len(s.vertices)
    assert len(root.findall(f".//{ns}triangle")) == s.n_faces


def test_e57_pages_check_and_hold_the_points():
    """CRC-32C of the standard's check string, then the file walked as ASTM E2807 describes it."""

    def crc(data):
        c = 0xFFFFFFFF
        for byte in data:
            c ^= byte
            for _ in range(8):
                c = (c >> 1) ^ (0x82F63B78 if c & 1 else 0)
        return c ^ 0xFFFFFFFF

    assert crc(b"123456789") == 0xE3069283
    page = _paged(b"fringescope")
    assert struct.unpack(">I", page[1020:])[0] == crc(page[:1020])
    c, f = cloud(5000), io.BytesIO()
    export.write_e57(c, f)
    raw = f.getvalue()
    signature, major, minor, size, xml_at, xml_size, page_size = struct.unpack_from("<8sIIQQQQ", raw)
    assert (signature, major, minor, size, page_size) == (b"ASTM-E57", 1, 0, len(raw), 1024)
    logical = b"".join(raw[i : i + 1020] for i in range(0, len(raw), 1024))
    start = xml_at // 1024 * 1020 + xml_at % 1024
    root = ElementTree.fromstring(logical[start : start + xml_size])
    ns = "{http://www.astm.org/COMMIT/E57/2010-e57-v1.0}"
    points = root.find(f".//{ns}points")
    assert points.attrib["recordCount"] == "5000"
    at = int(points.attrib["fileOffset"])
    at = at // 1024 * 1020 + at % 1024
    _, section, packet, _ = struct.unpack_from("<B7xQQQ", logical, at)
    assert section % 4 == 0
    packet = packet // 1024 * 1020 + packet % 1024
    xs = []
    while packet < at + section:
        kind, _, length, streams = struct.unpack_from("<BBHH", logical, packet)
        sizes = struct.unpack_from(f"<{streams}H", logical, packet + 6)
        assert kind == 1
        assert (length + 1) % 4 == 0
        xs.append(np.frombuffer(logical, "<f4", sizes[0] // 4, packet + 6 + 2 * streams))
        packet += length + 1
    np.testing.assert_allclose(np.concatenate(xs), c.xyz[:, 0] / 1000, rtol=1e-6)
    with pytest.raises(OutputError, match="empty cloud"):
        export.write_e57(cloud(0), io.BytesIO())
