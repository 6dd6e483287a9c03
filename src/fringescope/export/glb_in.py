"""Surfaces back from the GLB files that we write, for export to other formats."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fringescope.errors import FormatError
from fringescope.types import U32, AnyArray, Surface, SurfacePart

_KINDS: dict[int, np.dtype[Any]] = {5126: np.dtype("<f4"), 5125: np.dtype("<u4"), 5123: np.dtype("<u2")}
_WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}


def read_glb(path: str | Path) -> Surface:
    """The textured surface of a `surface.glb`, in world mm; vertices that its parts share become one again.

    Reads what `write_glb` writes, not every glTF. Raises FormatError for anything else, or a truncated file.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as e:
        raise FormatError(f"{path}: cannot read the surface: {e.strerror}") from e
    try:
        return _surface(data)
    except (KeyError, IndexError, TypeError, ValueError, struct.error, cv2.error) as e:
        raise FormatError(f"{path}: not a surface of this program, or truncated ({type(e).__name__}: {e})") from e


def read_pictures(path: str | Path) -> list[tuple[bytes, str]]:
    """The pictures of a `surface.glb` as they lie there, with their media types, in the order of its parts.

    Raises FormatError.
    """
    try:
        doc, binary = _chunks(Path(path).read_bytes())
        views = [(doc["bufferViews"][i["bufferView"]], i["mimeType"]) for i in doc["images"]]
        return [(binary[v["byteOffset"] : v["byteOffset"] + v["byteLength"]], str(mime)) for v, mime in views]
    except (OSError, KeyError, IndexError, TypeError, ValueError, struct.error) as e:
        raise FormatError(f"{path}: not a surface of this program, or truncated ({type(e).__name__}: {e})") from e


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    magic, version, size = struct.unpack_from("<4sII", data, 0)
    if magic != b"glTF" or version != 2 or size != len(data):
        raise ValueError("needed a whole glTF 2 binary")
    length, kind = struct.unpack_from("<I4s", data, 12)
    doc = json.loads(data[20 : 20 + length])
    _, kind2 = struct.unpack_from("<I4s", data, 20 + length)
    if kind != b"JSON" or kind2 != b"BIN\0":
        raise ValueError("needed a JSON and a binary chunk")
    return doc, data[28 + length :]


def _surface(data: bytes) -> Surface:
    doc, binary = _chunks(data)

    def view(i: int) -> bytes:
        v = doc["bufferViews"][i]
        raw = binary[v["byteOffset"] : v["byteOffset"] + v["byteLength"]]
        if len(raw) != v["byteLength"]:
            raise ValueError("a buffer view ends outside the file")
        return raw

    def array(i: int) -> AnyArray:
        a: dict[str, Any] = doc["accessors"][i]
        values: AnyArray = np.frombuffer(view(a["bufferView"]), _KINDS[a["componentType"]])
        return values.reshape(int(a["count"]), _WIDTH[a["type"]])

    parts = doc["meshes"][0]["primitives"]
    xyz = [array(p["attributes"]["POSITION"]) for p in parts]
    normals = [array(p["attributes"]["NORMAL"]) for p in parts]
    vertices, first, merged = np.unique(np.concatenate(xyz), axis=0, return_index=True, return_inverse=True)
    at = np.split(merged.reshape(-1), np.cumsum([len(x) for x in xyz])[:-1])
    out = []
    for p, index in zip(parts, at, strict=True):
        texture = doc["materials"][p["material"]]["pbrMetallicRoughness"]["baseColorTexture"]["index"]
        image = doc["images"][doc["textures"][texture]["source"]]
        picture = cv2.imdecode(np.frombuffer(view(image["bufferView"]), np.uint8), cv2.IMREAD_COLOR)
        if picture is None:
            raise ValueError("a texture cannot be decoded")
        faces: U32 = array(p["indices"]).reshape(-1, 3).astype(np.uint32)
        if faces.size and int(faces.max()) >= len(index):
            raise ValueError("a triangle names a vertex that there is not")
        uv = array(p["attributes"]["TEXCOORD_0"]).astype(np.float32)
        rgb = np.ascontiguousarray(picture[..., ::-1])
        out.append(SurfacePart(int(p["extras"]["view"]), index.astype(np.uint32), uv, faces, rgb))
    return Surface(vertices.astype(np.float32), np.concatenate(normals)[first].astype(np.float32), tuple(out))
