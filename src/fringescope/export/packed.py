"""Surfaces as small GLB files for the wire: quantised, packed with meshopt, and with fewer triangles if wanted.

EXT_meshopt_compression and KHR_mesh_quantization: three.js and others read them; who does not takes the plain file.
Needs the package meshoptimizer (fringescope[meshopt]).
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from fringescope.errors import OutputError
from fringescope.export.glb import container, document, encode_picture, material, root_node
from fringescope.types import F32, U8, U32, Surface, SurfacePart

_LEVELS = 65535  #: of 16 bits
_EXTENSIONS = ("EXT_meshopt_compression", "KHR_mesh_quantization")
_ARRAY_BUFFER, _ELEMENT_BUFFER, _UINT16, _UINT32 = 34962, 34963, 5123, 5125
_SHRINK = tuple((0.5 ** (k / 2), q) for k in range(9) for q in (85, 75, 60))  #: pictures: scale, and JPEG quality
_WIDEST = 2048  #: pixels of a picture of the level that shows first

Picture = tuple[bytes, str]  #: JPEG or PNG, and its media type


def can_pack() -> bool:
    """Whether the package is here that packs."""
    try:
        importlib.import_module("meshoptimizer")
    except ImportError:
        return False
    return True


def _tools() -> Any:
    """Meshoptimizer, writing the stream that the extension describes."""
    try:
        m = importlib.import_module("meshoptimizer")
    except ImportError as e:
        raise OutputError("packed surfaces need meshoptimizer: pip install 'fringescope[meshopt]'") from e
    m.encode_vertex_version(0)
    m.encode_index_version(1)
    return m


def thinned(surface: Surface, triangles: int) -> Surface:
    """A surface of about so many triangles at most, over a subset of the vertices.

    The borders of parts stay as they are, so no gap opens between them; where borders alone have more triangles than
    are wanted, these are what is left. Raises OutputError without meshoptimizer.
    """
    if surface.n_faces <= triangles:
        return surface
    share = triangles / surface.n_faces
    parts = (_thinned(surface, part, round(share * len(part.faces))) for part in surface.parts)
    return replace(surface, parts=tuple(parts))


def _thinned(surface: Surface, part: SurfacePart, triangles: int) -> SurfacePart:
    if not len(part.faces):
        return part
    m = _tools()
    xyz = np.ascontiguousarray(surface.vertices[part.vertex_index], np.float32)
    indices = np.ascontiguousarray(part.faces, np.uint32).reshape(-1)
    out = np.zeros(len(indices), np.uint32)
    count = m.simplify(
        out, indices, xyz, len(indices), len(xyz), 12, 3 * max(triangles, 1), 1.0, m.SIMPLIFY_LOCK_BORDER
    )
    kept, faces = np.unique(out[:count], return_inverse=True)
    return replace(
        part, vertex_index=part.vertex_index[kept], uv=part.uv[kept],
        faces=np.asarray(faces.reshape(-1, 3), np.uint32),
    )  # fmt: skip


def _ordered(part: SurfacePart) -> tuple[U32, U32]:
    """Faces and the vertices (of the part) that they use, in an order that packs well."""
    m = _tools()
    indices = np.ascontiguousarray(part.faces, np.uint32).reshape(-1)
    n = len(part.vertex_index)
    better = np.zeros_like(indices)
    m.optimize_vertex_cache(better, indices, len(indices), n)
    to = np.zeros(n, np.uint32)
    used = m.optimize_vertex_fetch_remap(to, better, len(better), n)
    order = np.argsort(to, kind="stable")[:used]  # what no triangle uses has the highest number
    return to[better].reshape(-1, 3), order.astype(np.uint32)


class _Packed:
    """The binary chunk of packed views and pictures, and the buffer that stands for what they unpack to."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.unpacked = 0
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def _append(self, raw: bytes) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        at = len(self.data)
        self.data += raw
        return at

    def picture(self, raw: bytes) -> int:
        self.views.append({"buffer": 0, "byteOffset": self._append(raw), "byteLength": len(raw)})
        return len(self.views) - 1

    def packed(self, raw: bytes, count: int, stride: int, mode: str, target: int) -> int:
        how = {"buffer": 0, "byteOffset": self._append(raw), "byteLength": len(raw), "byteStride": stride,
               "mode": mode, "count": count}  # fmt: skip
        view = {"buffer": 1, "byteOffset": self.unpacked, "byteLength": count * stride, "target": target,
                "extensions": {_EXTENSIONS[0]: how}}  # fmt: skip
        self.views.append(view | ({"byteStride": stride} if mode == "ATTRIBUTES" else {}))
        self.unpacked += -(-count * stride // 4) * 4
        return len(self.views) - 1

    def accessor(self, view: int, count: int, kind: str, component: int, **more: Any) -> int:
        self.accessors.append({"bufferView": view, "componentType": component, "count": count, "type": kind, **more})
        return len(self.accessors) - 1


def _grid(surface: Surface) -> tuple[F32, float]:
    """Where the grid of 16 bits begins, and its step (mm): one for all parts, so that what they share stays shared."""
    used = np.concatenate([surface.vertices[p.vertex_index] for p in surface.parts if len(p.faces)])
    low, high = used.min(axis=0), used.max(axis=0)
    return low, max(float((high - low).max()) / _LEVELS, 1e-9)


def packed_bytes(
    surface: Surface, pictures: Sequence[Picture], extras: Mapping[str, Any] | None = None
) -> bytes:  # fmt: skip
    """A surface as the bytes of a packed GLB; `pictures` are those of the parts that have triangles.

    Places are rounded to 16 bits over the surface's longest side: `extras` tells the step, `step_um`; no place is off
    by more than half of it along each axis. Texture coordinates have 16 bits; there are no normals. Raises OutputError
    for a surface without triangles, or without meshoptimizer.
    """
    parts = [p for p in surface.parts if len(p.faces)]
    if not parts:
        raise OutputError("a surface without triangles; GLB needs at least one")
    m, b = _tools(), _Packed()
    low, step = _grid(surface)
    primitives, materials, textures, images = (list[dict[str, Any]]() for _ in range(4))
    for i, (part, (raw, mime)) in enumerate(zip(parts, pictures, strict=True)):
        faces, order = _ordered(part)
        n = len(order)
        xyz = np.zeros((n, 4), "<u2")  # a row of four: views of attributes have strides of 4 bytes
        xyz[:, :3] = np.rint((surface.vertices[part.vertex_index[order]].astype(np.float64) - low) / step)
        uv = np.rint(np.clip(part.uv[order], 0, 1) * _LEVELS).astype("<u2")
        wide = n > _LEVELS - 1
        at = b.packed(m.encode_vertex_buffer(xyz, n, 8), n, 8, "ATTRIBUTES", _ARRAY_BUFFER)
        bounds = {"min": xyz[:, :3].min(axis=0).tolist(), "max": xyz[:, :3].max(axis=0).tolist()}
        place = b.accessor(at, n, "VEC3", _UINT16, **bounds)
        at = b.packed(m.encode_vertex_buffer(uv, n, 4), n, 4, "ATTRIBUTES", _ARRAY_BUFFER)
        where = b.accessor(at, n, "VEC2", _UINT16, normalized=True)
        raw_faces = m.encode_index_buffer(faces.reshape(-1), faces.size, n)
        at = b.packed(raw_faces, faces.size, 4 if wide else 2, "TRIANGLES", _ELEMENT_BUFFER)
        primitives.append({
            "attributes": {"POSITION": place, "TEXCOORD_0": where},
            "indices": b.accessor(at, faces.size, "SCALAR", _UINT32 if wide else _UINT16),
            "material": len(materials), "mode": 4, "extras": {"view": part.view},
        })  # fmt: skip
        materials.append(material(part.view, len(textures)))
        textures.append({"sampler": 0, "source": len(images)})
        images.append({"name": f"picture {i}", "mimeType": mime, "bufferView": b.picture(raw)})
    b.data += b"\0" * (-len(b.data) % 4)
    buffers = [{"byteLength": len(b.data)},
               {"byteLength": b.unpacked, "extensions": {_EXTENSIONS[0]: {"fallback": True}}}]  # fmt: skip
    made = {"meshes": [{"name": "surface", "primitives": primitives}], "materials": materials, "textures": textures,
            "images": images, "accessors": b.accessors, "bufferViews": b.views, "buffers": buffers}  # fmt: skip
    nodes = [
        root_node({"children": [1]}),
        {"name": "grid", "mesh": 0, "scale": [step] * 3, "translation": low.astype(float).tolist()},
    ]
    told = {"triangles": sum(len(p.faces) for p in parts), "step_um": round(1e3 * step, 4), **(extras or {})}
    root = document(made, nodes, (*_EXTENSIONS, "KHR_materials_unlit"), told)
    return container(root | {"extensionsRequired": list(_EXTENSIONS)}, bytes(b.data))


def _shrunk(picture: U8, scale: float) -> U8:
    h, w = picture.shape[:2]
    if scale == 1:
        return picture
    size = max(1, round(w * scale)), max(1, round(h * scale))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def coarse_bytes(
    surface: Surface, triangles: int, most: int, extras: Mapping[str, Any] | None = None
) -> bytes:  # fmt: skip
    """The level that shows first: of so many triangles, and pictures so small that the whole has at most `most` bytes.

    A mesh that is too large in itself comes with the smallest pictures, and is larger. Raises OutputError.
    """
    few = thinned(surface, triangles)
    parts = [p for p in few.parts if len(p.faces)]
    bare = len(packed_bytes(few, [(b"", "image/jpeg")] * len(parts), extras))
    sources = [_shrunk(p.texture, min(1.0, _WIDEST / max(p.texture.shape[:2]))) for p in parts]
    pictures: list[Picture] = []
    for scale, quality in _SHRINK:
        pictures = [encode_picture(_shrunk(x, scale), quality) for x in sources]
        if bare + sum(len(raw) + 4 for raw, _ in pictures) <= most:
            break
    return packed_bytes(few, pictures, extras)
