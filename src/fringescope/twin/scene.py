"""Scenes with exact truth: plane, sphere, steps, board, three tissue specimens. One seed gives one scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fringescope.errors import UsageError
from fringescope.twin import boards, specimens
from fringescope.twin.shapes import Boxes, Plane, Shape, Sphere
from fringescope.twin.textures import Finish, Lazy, film, uniform
from fringescope.types import F64, Pose

CERAMIC = Finish(uniform((0.78, 0.78, 0.76)), scatter_mm=0.03)
STEEL = Finish(uniform((0.42, 0.42, 0.42)))
SUBSTRATE_Z = -6.0  #: mm; where specimens lie when nothing is lifted


@dataclass(frozen=True, eq=False)
class Scene:
    """What lies under the instrument, with the brightness that suits it and its truth files.

    `lamp` and `ring` scale the projector's and the ring light's brightness. `truth`: file name to content
    (JSON values, or arrays for .npz), laid out as the judge reads them.
    """

    name: str
    seed: int
    shapes: tuple[Shape, ...]
    lamp: float = 1.0
    ring: float = 1.0
    rays: int = 4  #: rays per pixel at edges that suit it
    truth: Mapping[str, Any] = field(default_factory=dict)


def names() -> tuple[str, ...]:
    """The scenes that `make` knows."""
    return ("plane", "sphere", "steps", "board", *specimens.SPECIMENS)


def make(name: str, seed: int = 0, lift: float = 0.0, pose: int = 0, board: str = "checkerboard") -> Scene:
    """A scene by name, placed at random by `seed`.

    `lift` raises everything by so many mm. `pose` numbers the poses of a board, `board` is "checkerboard" or
    "charuco". Raises UsageError for an unknown name.
    """
    rng = np.random.default_rng([seed, 1])
    if name == "plane":
        return _plane(seed, lift, rng)
    if name == "sphere":
        return _sphere(seed, lift, rng)
    if name == "steps":
        return _steps(seed, lift, rng)
    if name == "board":
        return _board(seed, lift, pose, board)
    if name in specimens.SPECIMENS:
        return _tissue(name, seed, lift)
    raise UsageError(f"scene '{name}' is unknown; there are {', '.join(names())}")


def _turn(axis: str, angle: float) -> F64:
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    R = np.eye(3)
    R[i, i] = R[j, j] = np.cos(angle)
    R[j, i], R[i, j] = np.sin(angle), -np.sin(angle)
    return R


def tilted_plane(R: F64, point: tuple[float, float, float], finish: Finish = CERAMIC) -> Plane:
    """An endless plane through `point` whose normal is the third column of the rotation `R`."""
    return Plane(finish, Pose(R, np.asarray(point, dtype=np.float64)))


def _plane(seed: int, lift: float, rng: np.random.Generator) -> Scene:
    a, b, z = rng.uniform([-0.1, -0.1, -3.0], [0.1, 0.1, 3.0])
    R = _turn("x", a) @ _turn("y", b)
    point = (0.0, 0.0, float(z) + lift)
    truth = {"plane.json": {"normal": R[:, 2].tolist(), "point": list(point)}}
    return Scene("plane", seed, (tilted_plane(R, point),), truth=truth)


def _sphere(seed: int, lift: float, rng: np.random.Generator) -> Scene:
    base = -9.0 + lift
    small, large = rng.uniform(-2, 2, (2, 2))
    places = ((5.00065, small[0] - 8.0, small[1] + 3.0), (12.0, large[0] + 25.0, large[1] - 5.0))
    balls = [Sphere(CERAMIC, (float(x), float(y), base + r), r) for r, x, y in places]
    shapes: list[Shape] = [tilted_plane(np.eye(3), (0.0, 0.0, base), STEEL)]
    shapes += balls
    spheres = [{"center": list(b.center), "radius": b.radius} for b in balls]
    return Scene("sphere", seed, tuple(shapes), truth={"sphere.json": {"spheres": spheres, "base_z": base}})


def _steps(seed: int, lift: float, rng: np.random.Generator) -> Scene:
    base, heights = -6.0 + lift, (1.0, 3.0, 6.0, 10.0, 5.0, 2.0)
    R, t = _turn("z", rng.uniform(-0.3, 0.3)), np.array([*rng.uniform(-2, 2, 2), base])
    edges = np.linspace(-36, 36, len(heights) + 1)
    low = np.array([[edges[k], -18.0, -1.0] for k in range(len(heights))])
    high = np.array([[edges[k + 1], 18.0, h] for k, h in enumerate(heights)])
    shapes = (tilted_plane(np.eye(3), (0.0, 0.0, base), STEEL), Boxes(CERAMIC, low, high, Pose(R, t)))
    steps = [{"low": [*a[:2], 0.0], "high": list(map(float, b))} for a, b in zip(low.tolist(), high, strict=True)]
    truth = {"steps.json": {"base_z": base, "R": R.tolist(), "t": t.tolist(), "steps": steps}}
    return Scene("steps", seed, shapes, truth=truth)


def board_pose(seed: int, pose: int, board: boards.Board, lift: float = 0.0) -> Pose:
    """T_world_board of pose number `pose`: the first faces the projector, the others lean up to 25 degrees."""
    rng = np.random.default_rng([seed, 2, pose])
    (x0, x1), (y0, y1) = board.extent
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2, 0.0])
    lean = 0.03 if pose == 0 else rng.uniform(0.12, 0.43)
    towards = 2.4 * pose + rng.uniform(-0.4, 0.4)
    R = _turn("z", towards) @ _turn("x", lean) @ _turn("z", -towards + rng.uniform(-0.3, 0.3)) @ np.diag([1.0, -1, -1])
    at = rng.uniform([-9, -6, -9], [9, 6, 9]) + np.array([0, 0, lift])
    return Pose(R, at - R @ middle)


def _board(seed: int, lift: float, pose: int, kind: str) -> Scene:
    if kind not in ("checkerboard", "charuco"):
        raise UsageError(f"board '{kind}' is unknown; needed checkerboard or charuco")
    board = boards.checkerboard() if kind == "checkerboard" else boards.charuco()
    T = board_pose(seed, pose, board, lift)
    x, y = board.extent
    sheet = Plane(Finish(board.albedo), T, x, y)
    floor = tilted_plane(np.eye(3), (0.0, 0.0, -45.0 + lift), Finish(uniform((0.05, 0.05, 0.05))))
    truth = {"poses.json": [{"R": T.R.tolist(), "t": T.t.tolist()}], "board.json": board.spec}
    return Scene("board", seed, (floor, sheet), lamp=0.95, rays=16, truth=truth)


def _tissue(name: str, seed: int, lift: float) -> Scene:
    base = SUBSTRATE_Z + lift
    mesh, arrays = specimens.build(name, seed, base)
    wet = Lazy(lambda: film(seed + 1, 0.05, 4.0, 90.0, 0.6))
    tray = Finish(uniform((0.16, 0.18, 0.20)), alpha=0.05, f0=0.035, bumps=wet)
    floor = tilted_plane(np.eye(3), (0.0, 0.0, base), tray)
    truth = {"tissue.json": {"mesh": "tissue_mesh.npz", "base_z": base}, "tissue_mesh.npz": arrays}
    return Scene(name, seed, (floor, mesh), lamp=specimens.SPECIMENS[name].lamp, ring=1.5, truth=truth)
