"""One self-contained page that shows a surface in any browser: nothing to install, nothing fetched."""

from __future__ import annotations

import base64
import html
import json
from importlib import resources

import numpy as np

from fringescope.errors import OutputError
from fringescope.export.glb import encode_picture
from fringescope.types import AnyArray, Surface


def _text(a: AnyArray) -> str:
    return base64.b64encode(np.ascontiguousarray(a).tobytes()).decode("ascii")


def viewer_page(surface: Surface, title: str = "Scan", note: str = "", quality: int = 85) -> str:
    """HTML of a page with the surface inside: orbit, zoom, colour, relief, height, views, distances in mm.

    Meant for the small level of detail (`fuse.surface(...)[-1]`, about a megabyte). Positions are stored in 16 bits
    per axis (1.5 um over 100 mm), pictures as JPEG of `quality`. Its hash sets the first view, for example
    `#mode=height&azimuth=-60&elevation=40&zoom=1.5`. Raises OutputError if the surface has no triangles.
    """
    if not surface.n_faces:
        raise OutputError("a surface without triangles; the page needs at least one")
    low, high = surface.vertices.min(axis=0).astype(np.float64), surface.vertices.max(axis=0).astype(np.float64)
    span = np.where(high > low, high - low, 1.0)
    parts = []
    for part in surface.parts:
        xyz = surface.vertices[part.vertex_index]
        normal = np.zeros((len(xyz), 4), "<i2")
        normal[:, :3] = np.rint(np.clip(surface.normals[part.vertex_index], -1, 1) * 32767)
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
            "range": np.percentile(surface.vertices[:, 2], [0.5, 99.5]).astype(float).tolist(), "parts": parts}
    page = (resources.files("fringescope.export") / "viewer.html").read_text(encoding="utf-8")
    return page.replace("@TITLE@", html.escape(title)).replace("@DATA@", json.dumps(data).replace("<", "\\u003c"))
