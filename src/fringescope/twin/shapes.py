"""What rays can hit: analytic plane, sphere and boxes (exact), a triangle mesh (Embree, refined in float64)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from fringescope.twin import loops
from fringescope.twin.textures import Finish
from fringescope.types import F64, AnyArray, Bool, Pose

NEAR = 1e-6  #: mm; hits nearer than this to a ray's origin do not count


class Shape(Protocol):
    """A surface that rays can hit."""

    @property
    def finish(self) -> Finish:
        """Colour and shine."""
        ...

    def hit(self, origins: F64, directions: F64) -> tuple[F64, F64]:
        """Distances (n,) along unit directions (inf = missed) and unit normals (n, 3) at the hits."""
        ...

    def local(self, points: F64) -> F64:
        """World points (n, 3) in the coordinates in which the finish is defined."""
        ...

    def blocks(self, origins: F64, directions: F64, reach: F64) -> Bool:
        """Whether something lies within `reach` (n,) of the origins."""
        ...

    def offset(self, points: F64) -> F64:
        """Distances (n,) mm of world points (n, 3) from the surface, positive above or outside; inf = no surface there.
        """
        ...


class _Analytic(ABC):
    """Shadow by intersection."""

    @abstractmethod
    def hit(self, origins: F64, directions: F64) -> tuple[F64, F64]:
        """See `Shape`."""

    @abstractmethod
    def offset(self, points: F64) -> F64:
        """See `Shape`."""

    def blocks(self, origins: F64, directions: F64, reach: F64) -> Bool:
        """See `Shape`."""
        return np.asarray(self.hit(origins, directions)[0] < reach)


IDENTITY = Pose(np.eye(3), np.zeros(3))


@dataclass(frozen=True, eq=False)
class Plane(_Analytic):
    """A rectangle in the plane z = 0 of its own frame (T_world_own), x in `x_range`, y in `y_range`, seen from both
    sides.
    """

    finish: Finish
    pose: Pose = IDENTITY  #: p_world = R p_own + t
    x_range: tuple[float, float] = (-np.inf, np.inf)
    y_range: tuple[float, float] = (-np.inf, np.inf)

    def local(self, points: F64) -> F64:
        """World to own coordinates."""
        return np.asarray((points - self.pose.t) @ self.pose.R)

    def hit(self, origins: F64, directions: F64) -> tuple[F64, F64]:
        """See `Shape`."""
        normal = self.pose.R[:, 2]
        along = directions @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((self.pose.t - origins) @ normal) / along
            p = self.local(origins + t[:, None] * directions)
            ok = (t > NEAR) & (p[:, 0] >= self.x_range[0]) & (p[:, 0] <= self.x_range[1])
            ok &= (p[:, 1] >= self.y_range[0]) & (p[:, 1] <= self.y_range[1])
        return np.where(ok, t, np.inf), np.where(along[:, None] < 0, 1.0, -1.0) * normal

    def offset(self, points: F64) -> F64:
        """See `Shape`: above is where z of the world grows."""
        p = self.local(points)
        beside = p[:, 0] - np.clip(p[:, 0], *self.x_range), p[:, 1] - np.clip(p[:, 1], *self.y_range)
        away = np.sqrt(p[:, 2] ** 2 + beside[0] ** 2 + beside[1] ** 2)
        return np.asarray(np.where((p[:, 2] < 0) == (self.pose.R[2, 2] < 0), away, -away))


@dataclass(frozen=True, eq=False)
class Sphere(_Analytic):
    """A sphere, seen from outside."""

    finish: Finish
    center: tuple[float, float, float]
    radius: float

    def local(self, points: F64) -> F64:
        """World coordinates about the centre."""
        return np.asarray(points - np.asarray(self.center))

    def hit(self, origins: F64, directions: F64) -> tuple[F64, F64]:
        """See `Shape`."""
        o = origins - np.asarray(self.center)
        b = np.einsum("ij,ij->i", o, directions)
        # the point of the ray nearest to the centre, so that no large squares cancel
        m = o - b[:, None] * directions
        q = self.radius**2 - np.einsum("ij,ij->i", m, m)
        with np.errstate(invalid="ignore"):
            t = -b - np.sqrt(q)
        t = np.where((q > 0) & (t > NEAR), t, np.inf)
        with np.errstate(invalid="ignore"):
            n = np.where(
                np.isfinite(t)[:, None], (o + np.where(np.isfinite(t), t, 0)[:, None] * directions) / self.radius, 0
            )
        return t, n

    def offset(self, points: F64) -> F64:
        """See `Shape`."""
        return np.asarray(np.linalg.norm(self.local(points), axis=1) - self.radius)


@dataclass(frozen=True, eq=False)
class Boxes(_Analytic):
    """Boxes with sides along the axes of one frame (T_world_own): `low` and `high` corners (k, 3)."""

    finish: Finish
    low: F64
    high: F64
    pose: Pose = IDENTITY

    def local(self, points: F64) -> F64:
        """World to own coordinates."""
        return np.asarray((points - self.pose.t) @ self.pose.R)

    def hit(self, origins: F64, directions: F64) -> tuple[F64, F64]:
        """See `Shape`. Slab method; a ray that starts inside a box does not hit it."""
        o, d = self.local(origins), directions @ self.pose.R
        d = np.where(np.abs(d) < 1e-12, 1e-12, d)
        best = np.full(len(o), np.inf)
        normal = np.zeros((len(o), 3))
        for low, high in zip(self.low, self.high, strict=True):
            a, b = (low - o) / d, (high - o) / d
            enter, leave = np.minimum(a, b), np.maximum(a, b)
            axis = enter.argmax(1)
            t = enter.max(1)
            ok = (t < leave.min(1)) & (t > NEAR) & (t < best)
            best = np.where(ok, t, best)
            n = np.zeros_like(normal)
            rows = np.arange(len(o))
            n[rows, axis] = -np.sign(d[rows, axis])
            normal = np.where(ok[:, None], n, normal)
        return best, normal @ self.pose.R.T

    def offset(self, points: F64) -> F64:
        """See `Shape`: of the nearest box, whatever the others hide of it."""
        p = self.local(points)
        out = np.full(len(p), np.inf)
        for low, high in zip(self.low, self.high, strict=True):
            q = np.maximum(low - p, p - high)
            d = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)
            out = np.where(np.abs(d) < np.abs(out), d, out)
        return out


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh in world mm: vertices (n, 3), unit normals (n, 3), faces (m, 3).

    `pose` (T_world_own) is that of the coordinates in which its finish is defined.
    """

    finish: Finish
    vertices: F64
    normals: F64
    faces: AnyArray
    pose: Pose = IDENTITY
    _embree: list[Any] = field(default_factory=list, repr=False)

    def _scene(self) -> Any:
        if not self._embree:
            scene = EmbreeScene()
            mesh = TriangleMesh(scene, self.vertices.astype(np.float32), self.faces.astype(np.int32))
            scene.run(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))  # commits
            self._embree.extend([scene, mesh])
        return self._embree[0]

    def local(self, points: F64) -> F64:
        """World to own coordinates."""
        return points if self.pose is IDENTITY else np.asarray((points - self.pose.t) @ self.pose.R)

    def hit(self, origins: F64, directions: F64) -> tuple[F64, F64]:
        """See `Shape`. Embree finds the triangle; the distance is computed again in float64."""
        found = self._scene().run(
            np.ascontiguousarray(origins, np.float32), np.ascontiguousarray(directions, np.float32)
        )
        t, n = np.empty(len(origins)), np.zeros((len(origins), 3))
        o, d = np.ascontiguousarray(origins), np.ascontiguousarray(directions)
        loops.refine_triangle_hits(o, d, found, self.vertices, self.faces, self.normals, t, n)
        return t, n

    def blocks(self, origins: F64, directions: F64, reach: F64) -> Bool:
        """See `Shape`. `reach` is taken as endless: lights lie beyond every mesh."""
        del reach
        found = self._scene().run(
            np.ascontiguousarray(origins, np.float32), np.ascontiguousarray(directions, np.float32), query="OCCLUDED"
        )
        return np.asarray(found == 0)

    def offset(self, points: F64) -> F64:
        """See `Shape`: from the plane of the triangle that lies straight below or above, as of a height field."""
        top = float(self.vertices[:, 2].max()) + 1.0
        above = np.column_stack([points[:, :2], np.full(len(points), top)])
        down = np.broadcast_to([0.0, 0.0, -1.0], above.shape)
        found = self._scene().run(above.astype(np.float32), down.astype(np.float32))
        a, b, c = (self.vertices[self.faces[found, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True) * np.where(normal[:, 2:] < 0, -1.0, 1.0)
        return np.where(found < 0, np.inf, np.einsum("ij,ij->i", points - a, normal))


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays end: `shape` (n,) index or -1, `t` (n,) mm, `point` (n, 3), `normal` (n, 3) towards the viewer."""

    shape: AnyArray
    t: F64
    point: F64
    normal: F64


def trace(shapes: tuple[Shape, ...], origins: F64, directions: F64) -> Hits:
    """The nearest hit of each ray; `origins` (3,) or (n, 3), unit `directions` (n, 3)."""
    o = np.broadcast_to(origins, directions.shape)
    best, which = np.full(len(directions), np.inf), np.full(len(directions), -1, dtype=np.int32)
    normal = np.zeros((len(directions), 3))
    for k, s in enumerate(shapes):
        t, n = s.hit(o, directions)
        nearer = t < best
        best = np.where(nearer, t, best)
        which[nearer] = k
        normal[nearer] = n[nearer]
    point = o + np.where(which >= 0, best, 0.0)[:, None] * directions
    return Hits(which, best, point, normal)


def offsets(shapes: tuple[Shape, ...], points: F64) -> F64:
    """Distances (n,) mm of points (n, 3) from the nearest of the surfaces, positive above or outside it."""
    every = np.stack([s.offset(points) for s in shapes])
    return np.asarray(np.take_along_axis(every, np.abs(every).argmin(0)[None], 0)[0])


def lit(shapes: tuple[Shape, ...], points: F64, normals: F64, light: F64) -> Bool:
    """Whether nothing stands between surface points (n, 3) and a light at (3,); faces turned away are dark."""
    to = light - points
    reach = np.linalg.norm(to, axis=1)
    to /= reach[:, None]
    start = points + 0.02 * normals + 0.01 * to
    out = np.einsum("ij,ij->i", to, normals) > 0
    for s in shapes:
        k = np.flatnonzero(out)
        out[k] = ~s.blocks(start[k], to[k], reach[k])
    return np.asarray(out)
