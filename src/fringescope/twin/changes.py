"""What befalls a scene between a scan and a later look: motion, dents, something in the way, drying, weaker light.

Textures and wet films stay glued to what moves. The floor on which a specimen lies is the first shape of a scene of
several.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from fringescope.errors import UsageError
from fringescope.twin.scene import Scene
from fringescope.twin.shapes import Boxes, Mesh, Plane, Shape, Sphere
from fringescope.twin.textures import Finish, uniform
from fringescope.types import F64, Pose

GLOVE = Finish(uniform((0.20, 0.32, 0.62)), alpha=0.35, f0=0.03)
OPTIONS = ("move", "turn", "dent", "dry", "ring", "cover")  #: of `changed`
DENT_RADIUS = 5.0  #: mm


def moved(scene: Scene, pose: Pose, *, everything: bool = False) -> Scene:
    """The scene with its specimen moved rigidly: world points p become R p + t (mm). The floor stays, unless
    `everything` moves. Truth files of meshes and of boards follow; those of other shapes are left out.
    """
    still = 0 if everything or len(scene.shapes) == 1 else 1
    shapes = (*scene.shapes[:still], *(_moved(s, pose) for s in scene.shapes[still:]))
    truth: dict[str, Any] = {}
    if (mesh := scene.truth.get("tissue_mesh.npz")) is not None:
        truth = {**scene.truth, "tissue_mesh.npz": {**mesh, "V": mesh["V"] @ pose.R.T + pose.t}}
    elif (boards := scene.truth.get("poses.json")) is not None:
        each = [(pose.R @ np.array(p["R"]), pose.R @ np.array(p["t"]) + pose.t) for p in boards]
        truth = {**scene.truth, "poses.json": [{"R": R.tolist(), "t": t.tolist()} for R, t in each]}
    return replace(scene, shapes=shapes, truth=truth)


def motion(move_mm: F64, turn_rad: F64, about: F64) -> Pose:
    """The rigid motion that turns about the point `about` (3,) by the rotation vector `turn_rad` and then moves.

    By Rodrigues' formula.
    """
    angle = float(np.linalg.norm(turn_rad))
    x, y, z = np.asarray(turn_rad, dtype=np.float64) / (angle or 1.0)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    R = np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * (k @ k)
    return Pose(R, np.asarray(about) + np.asarray(move_mm) - R @ np.asarray(about))


def middle(scene: Scene) -> F64:
    """The middle (3,), world mm, of a scene's specimen: the mean of its mesh's vertices, or 0, 0, 0 without one."""
    for s in scene.shapes:
        if isinstance(s, Mesh):
            V = s.vertices[np.unique(s.faces)]
            return np.asarray(V.mean(axis=0))
    return np.zeros(3)


def dented(scene: Scene, at_mm: tuple[float, float], depth_mm: float, radius_mm: float = DENT_RADIUS) -> Scene:
    """The specimen pressed in by `depth_mm` at world (x, y): by (1 - (r / radius)^2)^3 of it at distance r.

    Vertices go down along the specimen's own z, so that its texture, a map of x and y, goes with them. A negative
    depth raises it. Raises UsageError where the scene has no mesh, or none within the radius.
    """
    meshes = [i for i, s in enumerate(scene.shapes) if isinstance(s, Mesh)]
    if not meshes or not radius_mm > 0:
        raise UsageError(f"a dent of radius {radius_mm:g} mm in the scene '{scene.name}'; needed tissue and a radius")
    mesh = scene.shapes[meshes[-1]]
    assert isinstance(mesh, Mesh)
    P = mesh.pose
    V, N = (mesh.vertices - P.t) @ P.R, mesh.normals @ P.R
    off = V[:, :2] - ((np.array([*at_mm, P.t[2]]) - P.t) @ P.R)[:2]
    inside = np.clip(1 - (off**2).sum(1) / radius_mm**2, 0, None)
    if not inside[mesh.faces].any():
        raise UsageError(f"a dent at {at_mm[0]:g}, {at_mm[1]:g} mm; there is no tissue within {radius_mm:g} mm of it")
    slope = (-6 * depth_mm / radius_mm**2 * inside**2)[:, None] * off  # of what is taken away
    V = V - np.array([0.0, 0.0, 1.0]) * (depth_mm * inside**3)[:, None]
    N = N + np.column_stack([N[:, 2:] * slope, np.zeros(len(N))])
    N /= np.linalg.norm(N, axis=1, keepdims=True)
    world = V @ P.R.T + P.t
    changed_mesh = Mesh(mesh.finish, world, N @ P.R.T, mesh.faces, P)
    shapes = tuple(changed_mesh if i == meshes[-1] else s for i, s in enumerate(scene.shapes))
    truth = scene.truth
    if (there := truth.get("tissue_mesh.npz")) is not None:
        truth = {**truth, "tissue_mesh.npz": {**there, "V": world}}
    return replace(scene, shapes=shapes, truth=truth)


def covered(scene: Scene, reach_mm: float, width_mm: float = 14.0, height_mm: float = 20.0) -> Scene:
    """A gloved finger in the view: a bar over the specimen from the rim at x = 60 mm inwards by `reach_mm`.

    Its underside hangs `height_mm` above z = 0.
    """
    low = np.array([[60.0 - reach_mm, -width_mm / 2, height_mm]])
    high = np.array([[75.0, width_mm / 2, height_mm + 14]])
    return replace(scene, shapes=(*scene.shapes, Boxes(GLOVE, low, high)))


def dried(scene: Scene, share: float) -> Scene:
    """The film dried by `share` (0..1): so much less is mirrored, by a rougher surface."""
    if not 0 <= share <= 1:
        raise UsageError(f"dried by {share:g}; needed a share of 0 to 1")
    return _finished(scene, lambda f: replace(f, f0=f.f0 * (1 - share), alpha=f.alpha * (1 + share)))


def relit(scene: Scene, factor: float) -> Scene:
    """The ring light `factor` times as bright."""
    if not factor >= 0:
        raise UsageError(f"a ring light {factor:g} times as bright; needed 0 or more")
    return replace(scene, ring=scene.ring * factor)


def changed(scene: Scene, told: Mapping[str, str]) -> Scene:
    """A scene after what `told` names, as text (empty: nothing): `move` x,y,z in mm; `turn` degrees about the
    specimen's middle, about z or x,y,z; `dent` depth or depth,x,y or depth,x,y,radius in mm; `dry` 0..1; `ring` factor;
    `cover` mm that a finger reaches in from the rim. Raises UsageError for others.
    """
    if told.get("move") or told.get("turn"):
        turn = _numbers(told, "turn", (1, 3)) or [0.0]
        turn = turn if len(turn) == 3 else [0.0, 0.0, *turn]
        step = np.array(_numbers(told, "move", (3,)) or [0.0, 0.0, 0.0])
        scene = moved(scene, motion(step, np.radians(turn), middle(scene)))
    if told.get("dent"):
        depth, *more = _numbers(told, "dent", (1, 3, 4))
        x, y, radius = (*more, *(0.0, 0.0, DENT_RADIUS)[len(more) :])
        scene = dented(scene, (x, y), depth, radius)
    if told.get("dry"):
        scene = dried(scene, _numbers(told, "dry", (1,))[0])
    if told.get("ring"):
        scene = relit(scene, _numbers(told, "ring", (1,))[0])
    if told.get("cover"):
        scene = covered(scene, _numbers(told, "cover", (1,))[0])
    return scene


def _numbers(told: Mapping[str, str], name: str, count: tuple[int, ...]) -> list[float]:
    text = told.get(name, "")
    if not text:
        return []
    try:
        out = [float(t) for t in text.split(",")]
    except ValueError:
        out = []
    if len(out) not in count or not all(map(math.isfinite, out)):
        raise UsageError(f"{name}={text}; needed {' or '.join(map(str, count))} numbers with commas between")
    return out


def _moved(s: Shape, pose: Pose) -> Shape:
    R, t = pose.R, pose.t
    if isinstance(s, Sphere):
        x, y, z = (R @ np.asarray(s.center) + t).tolist()
        return replace(s, finish=_turned(s.finish, R), center=(x, y, z))
    if isinstance(s, Mesh):
        own = Pose(R @ s.pose.R, R @ s.pose.t + t)
        return Mesh(_turned(s.finish, R), s.vertices @ R.T + t, s.normals @ R.T, s.faces, own)
    if isinstance(s, (Plane, Boxes)):
        return replace(s, finish=_turned(s.finish, R), pose=Pose(R @ s.pose.R, R @ s.pose.t + t))
    raise UsageError(f"a shape of kind {type(s).__name__} cannot be moved; needed plane, boxes, sphere or mesh")


def _turned(f: Finish, R: F64) -> Finish:
    """The same finish of a surface turned by R: the slopes of its film turn too."""
    if f.bumps is None or np.array_equal(R, np.eye(3)):
        return f
    bumps, flat = f.bumps, np.array(R[:2, :2])
    return replace(f, bumps=lambda p: bumps(p) @ flat.T)


def _finished(scene: Scene, how: Callable[[Finish], Finish]) -> Scene:
    """Every shape with its finish changed."""
    out: list[Shape] = []
    for s in scene.shapes:
        if isinstance(s, Mesh):
            out.append(Mesh(how(s.finish), s.vertices, s.normals, s.faces, s.pose))
        elif isinstance(s, (Plane, Boxes, Sphere)):
            out.append(replace(s, finish=how(s.finish)))
        else:
            out.append(s)
    return replace(scene, shapes=tuple(out))
