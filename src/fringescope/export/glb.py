"""Surfaces as GLB: plain core glTF 2.0, one primitive and one picture per textured part."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from fringescope.errors import OutputError
from fringescope.export.ply import Target, opened
from fringescope.types import U8, AnyArray, Surface

_FLOAT, _UINT16, _UINT32 = 5126, 5123, 5125
_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963


def encode_picture(rgb: U8, quality: int = 90) -> tuple[bytes, str]:
    """An sRGB picture (h, w, 3) as JPEG bytes (PNG where `quality` is above 100), and its MIME type."""
    suffix, options = (".png", []) if quality > 100 else (".jpg", [cv2.IMWRITE_JPEG_QUALITY, quality])
    ok, data = cv2.imencode(suffix, np.ascontiguousarray(rgb[..., ::-1]), options)
    if not ok:
        raise OutputError(f"a texture of {rgb.shape[1]} x {rgb.shape[0]} could not be encoded; crop or scale it")
    return data.tobytes(), "image/png" if quality > 100 else "image/jpeg"


class _Buffer:
    """The binary chunk as it grows, with its views and accessors."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, raw: bytes, target: int | None = None) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(raw)}
        self.views.append(view if target is None else view | {"target": target})
        self.data += raw
        return len(self.views) - 1

    def accessor(self, values: AnyArray, kind: str, component: int, target: int, bounds: bool = False) -> int:
        a = {"bufferView": self.view(values.tobytes(), target), "componentType": component, "count": len(values),
             "type": kind}
        if bounds:
            a |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        self.accessors.append(a)
        return len(self.accessors) - 1


def glb_bytes(surface: Surface, extras: Mapping[str, Any] | None = None, quality: int = 90, lit: bool = False,
              lean: bool = False) -> bytes:
    """A surface as the bytes of a GLB file.

    Vertices stay world mm, float32; one root node scales by 0.001 and turns z-up into glTF's y-up. `extras` (scan hash
    and so on) go beside the units into `asset.extras`. Pictures are JPEG of `quality`, or PNG above 100. Materials are
    unlit (KHR_materials_unlit, with the core material as what other viewers show), so that colours appear as the
    cameras saw them; `lit` leaves the light to the viewer. `lean` writes 16 bytes a vertex instead of 32: no normals,
    texture coordinates in 16 bits, both core glTF. Raises OutputError if a picture cannot be encoded.
    """
    b = _Buffer()
    primitives, materials, textures, images = (list[dict[str, Any]]() for _ in range(4))
    for i, part in enumerate(surface.parts):
        if not len(part.faces):
            continue
        xyz = np.ascontiguousarray(surface.vertices[part.vertex_index], dtype="<f4")
        small = len(xyz) < 65535
        indices = part.faces.astype("<u2" if small else "<u4").reshape(-1)
        picture, mime = encode_picture(part.texture, quality)
        attributes = {"POSITION": b.accessor(xyz, "VEC3", _FLOAT, _ARRAY_BUFFER, bounds=True)}
        if lean:
            uv = np.rint(np.clip(part.uv, 0, 1) * 65535).astype("<u2")
            attributes["TEXCOORD_0"] = b.accessor(uv, "VEC2", _UINT16, _ARRAY_BUFFER)
            b.accessors[-1]["normalized"] = True
        else:
            normals = surface.normals[part.vertex_index].astype(np.float64)
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
            attributes["NORMAL"] = b.accessor(normals.astype("<f4"), "VEC3", _FLOAT, _ARRAY_BUFFER)
            attributes["TEXCOORD_0"] = b.accessor(part.uv.astype("<f4"), "VEC2", _FLOAT, _ARRAY_BUFFER)
        primitives.append({
            "attributes": attributes,
            "indices": b.accessor(indices, "SCALAR", _UINT16 if small else _UINT32, _ELEMENT_BUFFER),
            "material": len(materials),
            "mode": 4,
            "extras": {"view": part.view},
        })
        materials.append(material(part.view, len(textures), lit))
        textures.append({"sampler": 0, "source": len(images)})
        images.append({"name": f"picture {i}", "mimeType": mime, "bufferView": b.view(picture)})
    if not primitives:
        raise OutputError("a surface without triangles; GLB needs at least one")
    b.data += b"\0" * (-len(b.data) % 4)
    parts = {"meshes": [{"name": "surface", "primitives": primitives}], "materials": materials, "textures": textures,
             "images": images, "accessors": b.accessors, "bufferViews": b.views,
             "buffers": [{"byteLength": len(b.data)}]}
    return container(document(parts, [root_node({"mesh": 0})], () if lit else ("KHR_materials_unlit",), extras),
                     bytes(b.data))


def material(view: int, texture: int, lit: bool = False) -> dict[str, Any]:
    """The material of what one view textures."""
    core = {
        "name": f"view {view}",
        "pbrMetallicRoughness": {"baseColorTexture": {"index": texture}, "metallicFactor": 0.0,
                                 "roughnessFactor": 0.9},
        "doubleSided": True,
    }
    return core if lit else core | {"extensions": {"KHR_materials_unlit": {}}}


def root_node(more: Mapping[str, Any]) -> dict[str, Any]:
    """The node that makes metres, y up, of our mm, z up."""
    half = math.sqrt(0.5)
    return {"name": "world_mm", **more, "scale": [0.001] * 3, "rotation": [-half, 0.0, 0.0, half]}


def document(
    parts: Mapping[str, Any], nodes: list[dict[str, Any]], used: tuple[str, ...], extras: Mapping[str, Any] | None
) -> dict[str, Any]:
    """A glTF of one scene, whose root is the first of the nodes."""
    root: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "fringescope", "extras": {"units": "mm", "up": "z", **(extras or {})}},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        **parts,
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
    }
    return root | {"extensionsUsed": list(used)} if used else root


def container(root: Mapping[str, Any], binary: bytes) -> bytes:
    """A glTF and its binary chunk, padded to 4 bytes already, as GLB."""
    text = json.dumps(root, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(binary)
    return (struct.pack("<4sII", b"glTF", 2, size) + struct.pack("<I4s", len(text), b"JSON") + text
            + struct.pack("<I4s", len(binary), b"BIN\0") + binary)


def write_glb(surface: Surface, target: Target, extras: Mapping[str, Any] | None = None, quality: int = 90,
              lit: bool = False) -> None:
    """Write `glb_bytes` to a path or a binary file object."""
    data = glb_bytes(surface, extras, quality, lit)
    with opened(target) as f:
        f.write(data)


def preview_bytes(surface: Surface, extras: Mapping[str, Any] | None = None, most: int = 1_000_000) -> bytes:
    """A lean GLB of at most `most` bytes: pictures get smaller, then coarser, until it fits.

    Scales go down by the square root of 2 from the cameras' sampling to 1/8 of it, at JPEG quality 85, 75 and 60 each.
    A mesh that is too large in itself comes with the smallest pictures, and is larger than `most`.
    """
    data = b""
    for halves in range(7):
        scale = 0.5 ** (halves / 2)
        parts = []
        for part in surface.parts:
            h, w = part.texture.shape[:2]
            size = (max(1, round(w * scale)), max(1, round(h * scale)))
            picture = part.texture if halves == 0 else cv2.resize(part.texture, size, interpolation=cv2.INTER_AREA)
            parts.append(replace(part, texture=np.asarray(picture, np.uint8)))
        for quality in (85, 75, 60):
            data = glb_bytes(replace(surface, parts=tuple(parts)), extras, quality, lean=True)
            if len(data) <= most:
                return data
    return data


def write_preview(surface: Surface, target: Target, extras: Mapping[str, Any] | None = None,
                  most: int = 1_000_000) -> None:
    """Write `preview_bytes` to a path or a binary file object."""
    data = preview_bytes(surface, extras, most)
    with opened(target) as f:
        f.write(data)
