"""What the covariance of a calibration says of measured points, before anything is measured."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from fringescope import geometry
from fringescope.types import (
    F64,
    Bool,
    Calibration,
    Camera,
    Lens,
    Parameter,
    Pose,
    Prediction,
    Projector,
    Rig,
    Slice,
    Volume,
)

GRID = (13, 9, 3)  #: points along the axes of the measuring volume, the last one towards the projector
SMALL = 0.01  #: step of the derivatives, in standard deviations of the parameter
_K = {"fx": ((0, 0),), "fy": ((1, 1),), "f": ((0, 0), (1, 1)), "cx": ((0, 2),), "cy": ((1, 2),)}
_DISTORTION = ("k1", "k2", "p1", "p2", "k3")
_TURN, _SHIFT = ("rx", "ry", "rz"), ("tx", "ty", "tz")


def moved(rig: Rig, device: str, name: str, step: float) -> Rig:
    """The rig with one parameter changed by `step` (see `Parameter`); unknown names leave it as it is."""

    def change(d: Camera | Projector) -> tuple[Lens, Pose]:
        K, distortion, R, t = d.lens.K.copy(), d.lens.distortion.copy(), d.pose.R, d.pose.t.copy()
        for at in _K.get(name, ()):
            K[at] += step
        if name in _DISTORTION:
            distortion[_DISTORTION.index(name)] += step
        if name in _TURN:
            R = Rotation.from_rotvec(step * np.eye(3)[_TURN.index(name)]).as_matrix() @ R
        if name in _SHIFT:
            t[_SHIFT.index(name)] += step
        return Lens(d.lens.width, d.lens.height, K, distortion), Pose(R, t)

    p = rig.projector
    if device == "projector":
        return Rig(Projector(p.width, p.height, p.layout, *change(p)), rig.cameras, rig.volume)
    cameras = tuple(Camera(c.name, *change(c)) if c.name == device else c for c in rig.cameras)
    return Rig(p, cameras, rig.volume)


def space(calibration: Calibration) -> Volume:
    """The rig's measuring volume, or the box around the boards; its last axis is the one towards the projector."""
    volume = calibration.rig.volume
    if volume is not None:
        right, _, forward = calibration.rig.projector.pose.R
        last = int(np.abs(volume.axes @ forward).argmax())
        first = max((i for i in range(3) if i != last), key=lambda i: abs(float(volume.axes[i] @ right)))
        order = [first, 3 - first - last, last]
        sign = np.sign([volume.axes[i][np.abs(volume.axes[i]).argmax()] for i in order])
        return Volume(volume.center, volume.axes[order] * sign[:, None], volume.half_size[order])
    points = board_points(calibration)
    low, high = np.percentile(points, [1, 99], axis=0)
    return Volume((low + high) / 2, np.eye(3), np.maximum((high - low) / 2, 1e-3))


def board_points(calibration: Calibration) -> F64:
    """World coordinates (n, 3) of every corner that some camera saw, mm."""
    seen = [
        geometry.transform(calibration.boards[s.pose], calibration.board.corner_mm(s.corner))
        for s in calibration.sightings
        if s.pose in calibration.boards
    ]
    return np.concatenate([np.zeros((0, 3)), *seen])


def triangulated(rig: Rig, camera: Camera, pixels: F64, uv: F64, g: F64, start: F64) -> F64:
    """Points (n, 3) where rays of `pixels` (n, 2) meet the surfaces g . (u, v) of `uv` (n, 2), from near `start`.

    Two steps of Newton: for small changes of a rig that is more than enough.
    """
    origin, d = geometry.world_rays(camera, pixels)
    t = ((start - origin) * d).sum(axis=-1)
    for _ in range(2):
        p = origin + t[:, None] * d
        away = geometry.project(rig.projector, p)
        slope = geometry.project(rig.projector, p + 1e-3 * d) - geometry.project(rig.projector, p - 1e-3 * d)
        t = t - ((away - uv) * g).sum(axis=-1) / ((slope * g).sum(axis=-1) / 2e-3)
    return np.asarray(origin + t[:, None] * d)


def fringe_direction(rig: Rig, camera: Camera, p: F64) -> F64:
    """Gradient (2,) of the fringes that tell most about depth at `p`: proportional to (Ju / fx^2, Jv / fy^2)."""
    d = p - geometry.centre(camera.pose)
    d = d / np.linalg.norm(d)
    J = geometry.project(rig.projector, p + 0.5 * d) - geometry.project(rig.projector, p - 0.5 * d)
    g = J / np.diag(rig.projector.lens.K)[:2] ** 2
    return np.asarray(g / np.linalg.norm(g))


def predict(calibration: Calibration) -> Prediction | None:
    """Systematic sigma of points over the measuring volume; None without a covariance or a common view.

    Each free parameter moves the points that fixed pixels and phases are triangulated to; the covariance turns that
    into a covariance of points. What moves all points of all views as one rigid body is no error of measurement and is
    taken away first, so that the figures do not depend on what holds the world still in the solve.
    """
    free = [p for p in calibration.parameters if not p.fixed]
    C = calibration.covariance[: len(free), : len(free)]
    if C.shape != (len(free), len(free)) or not free or not np.isfinite(C).all():
        return None
    volume = space(calibration)
    axes = [np.linspace(-1, 1, n) for n in GRID]
    ijk = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    points = volume.center + (ijk.reshape(-1, 3) * volume.half_size) @ volume.axes
    rig = calibration.rig
    seen = np.stack([_seen(rig, c, points) for c in rig.cameras])
    if not seen.any():
        return None
    sigma = np.sqrt(np.maximum(np.diag(C), 0))
    moves = np.stack([_moves(rig, c, points, free, sigma) for c in rig.cameras])  # (V, n, 3, p)
    seen &= np.isfinite(moves).all(axis=(2, 3))
    rho = C / np.where(np.outer(sigma, sigma) > 0, np.outer(sigma, sigma), 1)
    rest, scale = _without_rigid(moves[seen], np.broadcast_to(points, (*seen.shape, 3))[seen])
    moves = np.full_like(moves, np.nan)
    moves[seen] = rest
    spread = 1000 * np.sqrt(np.maximum(np.einsum("vnip,pq,vniq->vn", moves, rho, moves), 0))
    return Prediction(
        int(seen.any(axis=0).sum()),
        {c.name: _figures(spread[v][seen[v]]) for v, c in enumerate(rig.cameras)},
        _between(rig, moves, seen, rho, volume.axes[2]),
        {c.name: _slices(spread[v], volume) for v, c in enumerate(rig.cameras)},
        float(1e6 * np.sqrt(max(float(scale @ rho @ scale), 0.0))),
    )


def _seen(rig: Rig, camera: Camera, points: F64) -> Bool:
    return geometry.field_of_view(Rig(rig.projector, (camera,)), points)


def _moves(rig: Rig, camera: Camera, points: F64, free: list[Parameter], sigma: F64) -> F64:
    """How far (n, 3, p) one sigma of each parameter moves the points that this camera sees, mm."""
    pixels, uv = geometry.project(camera, points), geometry.project(rig.projector, points)
    g = fringe_direction(rig, camera, points.mean(axis=0))
    out = np.zeros((*points.shape, len(free)))
    for j, p in enumerate(free):
        if p.device not in ("projector", camera.name) or sigma[j] == 0:
            continue
        ends = []
        for step in (SMALL * sigma[j], -SMALL * sigma[j]):
            r = moved(rig, p.device, p.name, step)
            ends.append(triangulated(r, r.camera(camera.name), pixels, uv, g, points))
        out[..., j] = (ends[0] - ends[1]) / (2 * SMALL)
    return out


def _without_rigid(moves: F64, points: F64) -> tuple[F64, F64]:
    """`moves` (n, 3, p) less their best rigid movement, and the change of scale (p,) that is left in them."""
    q = points - points.mean(axis=0)
    n = len(q)
    turn = np.stack([np.cross(e, q) for e in np.eye(3)], axis=-1)
    shift = np.broadcast_to(np.eye(3), (n, 3, 3))
    basis, _ = np.linalg.qr(np.concatenate([shift, turn], axis=-1).reshape(3 * n, 6))
    flat = moves.reshape(3 * n, -1)
    rest = flat - basis @ (basis.T @ flat)
    scale = q.reshape(-1) @ rest / max(float((q**2).sum()), 1e-12)
    return rest.reshape(moves.shape), scale


def _figures(sigma_um: F64) -> tuple[float, float, float]:
    if not sigma_um.size:
        return float("nan"), float("nan"), float("nan")
    return float(np.median(sigma_um)), float(np.percentile(sigma_um, 95)), float(sigma_um.max())


def _between(rig: Rig, moves: F64, seen: Bool, rho: F64, up: F64) -> dict[str, tuple[float, float]]:
    out = {}
    for a, b in combinations(range(len(rig.cameras)), 2):
        both = seen[a] & seen[b]
        if both.any():
            d = np.einsum("nip,i->np", moves[a][both] - moves[b][both], up)
            sigma = 1000 * np.sqrt(np.maximum(np.einsum("np,pq,nq->n", d, rho, d), 0))
            out[f"{rig.cameras[a].name} - {rig.cameras[b].name}"] = (float(np.median(sigma)), float(sigma.max()))
    return out


def _slices(spread: F64, volume: Volume) -> tuple[Slice, ...]:
    """Planes through the volume across its last axis, rows along its second axis."""
    cube = spread.reshape(GRID)
    cx, cy, cz = volume.axes @ volume.center
    hx, hy, hz = volume.half_size
    extent = (float(cx - hx), float(cx + hx), float(cy - hy), float(cy + hy))
    return tuple(
        Slice(float(z), extent, tuple(tuple(float(x) for x in row) for row in cube[:, :, k].T))
        for k, z in enumerate(np.linspace(cz - hz, cz + hz, GRID[2]))
    )
