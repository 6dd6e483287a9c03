"""One self-contained page that shows a surface in any browser: nothing to install, nothing fetched."""

from __future__ import annotations

import base64
import html
import json
from importlib import resources

import numpy as np

from fringescope.errors import OutputError
from fringescope.export.glb import encode_picture
from fringescope.types import F64, AnyArray, Surface


def _text(a: AnyArray) -> str:
    return base64.b64encode(np.ascontiguousarray(a).tobytes()).decode("ascii")


def _upright(surface: Surface) -> F64:
    """Rotation (3, 3) from the world to the page's frame, whose z points out of the surface."""
    n = surface.normals.mean(axis=0).astype(np.float64)
    n /= max(float(np.linalg.norm(n)), 1e-9)
    if n[2] > 0.3:
        return np.eye(3)
    if n[2] < -0.3:  # a camera's frame: y down, z forward
        return np.diag([1.0, -1.0, -1.0])
    right = np.cross([0.0, 1.0, 0.0] if abs(n[1]) < 0.9 else [0.0, 0.0, 1.0], n)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(n, right), n])


def viewer_page(surface: Surface, title: str = "Scan", note: str = "", quality: int = 85) -> str:
    """HTML of a page with the surface inside: orbit, zoom, colour, relief, height, views, distances in mm.

    Meant for the small level of detail (`fuse.surface(...)[-1]`, about a megabyte). Positions are stored in 16 bits
    per axis (1.5 um over 100 mm), pictures as JPEG of `quality`. Its hash sets the first view, for example
    `#mode=height&azimuth=-60&elevation=40&zoom=1.5`. Raises OutputError if the surface has no triangles.
    """
    if not surface.n_faces:
        raise OutputError("a surface without triangles; the page needs at least one")
    R = _upright(surface)
    vertices, normals = surface.vertices @ R.T, surface.normals @ R.T
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    span = np.where(high > low, high - low, 1.0)
    parts = []
    for part in surface.parts:
        xyz = vertices[part.vertex_index]
        normal = np.zeros((len(xyz), 4), "<i2")
        normal[:, :3] = np.rint(np.clip(normals[part.vertex_index], -1, 1) * 32767)
        picture, mime = encode_picture(part.texture, quality)
        wide = len(xyz) > 65535
        parts.append({
            "view": part.view,
            "xyz": _text(np.rint((xyz - low) / span * 65535).astype("<u2")),
            "normal": _text(normal),
            "uv": _text(np.rint(np.clip(part.uv, 0, 1) * 65535).astype("<u2")),
            "index": _text(part.faces.astype("<u4" if wide else "<u2")),
            "wide": wide,
            "picture": f"data:{mime};base64,{base64.b64encode(picture).decode('ascii')}",
        })
    data = {"title": title, "note": note or "1 unit = 1 mm", "low": low.tolist(), "high": (low + span).tolist(),
            "range": np.percentile(vertices[:, 2], [0.5, 99.5]).tolist(), "turned": R.tolist(), "parts": parts}
    page = (resources.files("fringescope.export") / "viewer.html").read_text(encoding="utf-8")
    return page.replace("@TITLE@", html.escape(title)).replace("@DATA@", json.dumps(data).replace("<", "\\u003c"))
