"""Cuts into the twin's specimens, with the exact volume that they take away: groove, pocket, slab, wedge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from fringescope.errors import UsageError
from fringescope.twin.scene import Scene
from fringescope.twin.shapes import Mesh
from fringescope.types import F64, Bool

WALL_MM = 0.15  #: width over which a wall falls from the old surface to the floor of the cut


@dataclass(frozen=True, eq=False)
class Removed:
    """What a cut took away, exactly, from the two height fields (piecewise linear on the mesh's triangles).

    `x`, `y`, `depth_mm` (n, n): the vertices and how much lower each is. `path` (m, 3): the path in world mm, on the
    surface before the cut.
    """

    volume_mm3: float
    area_mm2: float  #: seen along z, where the surface is lower
    max_depth_mm: float
    x: F64
    y: F64
    depth_mm: F64
    path: F64


def cut(
    scene: Scene,
    path: Sequence[tuple[float, float]] | F64,
    depth_mm: float,
    width_mm: float = 2.0,
    kind: str = "groove",
) -> tuple[Scene, Removed]:
    """A scene whose specimen (its height field) is cut along `path` (m, 2) in world mm; and what was removed.

    kind "groove": a kerf of `width_mm`, with steep walls. "pocket": all inside the closed path. "slab": all to the left
    of the path (which must run from edge to edge, without turning back). "wedge": the same, `depth_mm` deep at
    `width_mm` from the path and beyond, rising to the old surface at the path. Nothing is cut below the substrate.
    Raises UsageError for another kind, a path without length or sizes that are not positive.
    """
    line = np.asarray(path, dtype=np.float64)
    if line.ndim != 2 or line.shape[1] != 2 or len(line) < 2 or not np.isfinite(line).all():
        raise UsageError(f"a cut along a path of shape {line.shape}; needed (m, 2) finite mm, at least two points")
    if kind not in _PROFILES:
        raise UsageError(f"cut '{kind}' is unknown; there are {', '.join(_PROFILES)}")
    if not (depth_mm > 0 and width_mm > 0):
        raise UsageError(f"a cut {depth_mm} mm deep and {width_mm} mm wide; needed positive sizes")
    which = next((k for k, s in enumerate(scene.shapes) if isinstance(s, Mesh)), None)
    if which is None:
        raise UsageError(f"scene '{scene.name}' has no height field to cut; take one of the tissue scenes")
    mesh = scene.shapes[which]
    assert isinstance(mesh, Mesh)
    base = float(scene.truth["tissue.json"]["base_z"])
    n = round(len(mesh.vertices) ** 0.5)
    x, y, z = (mesh.vertices[:, k].reshape(n, n) for k in range(3))
    share = _PROFILES[kind](x, y, line, width_mm)
    top = np.maximum(z, base)
    new = np.where(z > base, np.maximum(z - depth_mm * share, np.minimum(z, base - 0.02)), z)
    gone = top - np.maximum(new, base)
    V = np.stack([x, y, new], -1).reshape(-1, 3)
    lower = Mesh(mesh.finish, V, _normals(x, y, new), mesh.faces)
    arrays = dict(scene.truth["tissue_mesh.npz"], V=V)
    shapes = tuple(lower if k == which else s for k, s in enumerate(scene.shapes))
    removed = Removed(
        _integral(x, y, gone), _integral(x, y, (gone > 1e-9).astype(float)), float(gone.max()), x, y, gone,
        np.column_stack([line, height_at(x, y, top, line)]),
    )  # fmt: skip
    return replace(scene, shapes=shapes, truth={**scene.truth, "tissue_mesh.npz": arrays}), removed


def solid(scene: Scene) -> tuple[float, float, float]:
    """Volume (mm^3) and footprint (mm^2) above the substrate, and height (mm), of a specimen; exact on its mesh."""
    mesh = next(s for s in scene.shapes if isinstance(s, Mesh))
    n = round(len(mesh.vertices) ** 0.5)
    x, y, z = (mesh.vertices[:, k].reshape(n, n) for k in range(3))
    h = np.maximum(z - float(scene.truth["tissue.json"]["base_z"]), 0)
    return _integral(x, y, h), _integral(x, y, (h > 0).astype(float)), float(h.max())


def height_at(x: F64, y: F64, z: F64, points: F64) -> F64:
    """Bilinear z (m,) at points (m, 2) of a regular grid x, y, z (n, n), x along the columns."""
    n = len(x)
    u = np.clip((points[:, 0] - x[0, 0]) / (x[0, -1] - x[0, 0]) * (n - 1), 0, n - 1.001)
    v = np.clip((points[:, 1] - y[0, 0]) / (y[-1, 0] - y[0, 0]) * (n - 1), 0, n - 1.001)
    i, j = v.astype(int), u.astype(int)
    a, b = v - i, u - j
    low = z[i, j] * (1 - b) + z[i, j + 1] * b
    return np.asarray(low * (1 - a) + (z[i + 1, j] * (1 - b) + z[i + 1, j + 1] * b) * a)


def _integral(x: F64, y: F64, h: F64) -> float:
    """Of a function that is linear on the two triangles (a, b, d) and (a, d, c) of each cell."""
    a, b, c, d = h[:-1, :-1], h[:-1, 1:], h[1:, :-1], h[1:, 1:]
    cell = abs(float((x[0, 1] - x[0, 0]) * (y[1, 0] - y[0, 0])))
    return cell * float((a / 3 + d / 3 + b / 6 + c / 6).sum())


def _normals(x: F64, y: F64, z: F64) -> F64:
    gy, gx = np.gradient(z, float(y[1, 0] - y[0, 0]), float(x[0, 1] - x[0, 0]))
    N = np.stack([-gx, -gy, np.ones_like(z)], -1).reshape(-1, 3)
    return np.asarray(N / np.linalg.norm(N, axis=1, keepdims=True))


def _offsets(x: F64, y: F64, line: F64) -> tuple[F64, F64]:
    """Distance from a polyline, and from the nearest piece's endless line, positive to its left."""
    best, side = np.full(x.shape, np.inf), np.zeros(x.shape)
    last = len(line) - 2
    for k, (p, q) in enumerate(pairwise(line)):
        d = q - p
        length = max(float(np.hypot(*d)), 1e-12)
        along = ((x - p[0]) * d[0] + (y - p[1]) * d[1]) / length**2
        on = np.clip(along, -np.inf if k == 0 else 0.0, np.inf if k == last else 1.0)
        off = np.hypot(x - p[0] - on * d[0], y - p[1] - on * d[1])
        left = ((y - p[1]) * d[0] - (x - p[0]) * d[1]) / length
        side = np.where(off < best, np.copysign(off, left), side)
        best = np.minimum(best, off)
    within = np.full(x.shape, np.inf)
    for p, q in pairwise(line):
        d = q - p
        t = np.clip(((x - p[0]) * d[0] + (y - p[1]) * d[1]) / max(float(d @ d), 1e-24), 0, 1)
        within = np.minimum(within, np.hypot(x - p[0] - t * d[0], y - p[1] - t * d[1]))
    return within, side


def _groove(x: F64, y: F64, line: F64, width: float) -> F64:
    return np.asarray(np.clip((width / 2 - _offsets(x, y, line)[0]) / WALL_MM, 0, 1))


def _slab(x: F64, y: F64, line: F64, _width: float) -> F64:
    return np.asarray(np.clip(_offsets(x, y, line)[1] / WALL_MM, 0, 1))


def _wedge(x: F64, y: F64, line: F64, width: float) -> F64:
    return np.asarray(np.clip(_offsets(x, y, line)[1] / width, 0, 1))


def _inside(x: F64, y: F64, line: F64) -> Bool:
    """Whether points lie in a closed polygon: crossings of the ray to the right."""
    odd = np.zeros(x.shape, dtype=bool)
    for p, q in zip(line, np.roll(line, -1, axis=0), strict=True):
        straddles = (p[1] > y) != (q[1] > y)
        with np.errstate(divide="ignore", invalid="ignore"):
            odd ^= straddles & (x < p[0] + (y - p[1]) / (q[1] - p[1]) * (q[0] - p[0]))
    return odd


def _pocket(x: F64, y: F64, line: F64, _width: float) -> F64:
    from_rim = _offsets(x, y, np.vstack([line, line[:1]]))[0]
    return np.where(_inside(x, y, line), np.clip(from_rim / WALL_MM, 0, 1), 0.0)


_PROFILES = {"groove": _groove, "pocket": _pocket, "slab": _slab, "wedge": _wedge}
