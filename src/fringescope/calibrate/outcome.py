"""What the adjustment found, put into the world frame: rig, boards, parameters with covariance, residuals, figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fringescope import geometry
from fringescope.calibrate.adjust import NORMAL_MAD, Fit, released, residuals
from fringescope.calibrate.initial import projector_coordinates
from fringescope.calibrate.problem import (
    CORNERS,
    LENS,
    PHASE,
    POSE,
    SHAPE,
    Block,
    Problem,
    State,
    evaluate,
    folded,
    inverse_normal,
    normal,
    sample_block,
)
from fringescope.settings import CalibrateSettings
from fringescope.types import (
    F64,
    Board,
    Calibration,
    Camera,
    LeftOut,
    Lens,
    Parameter,
    Pose,
    Projector,
    Residuals,
    Rig,
    Sighting,
    Volume,
)

FACING = np.diag([1.0, -1.0, -1.0])  #: R_projector_world: x along u, z towards the projector
UNITS = {
    **dict.fromkeys(LENS[:4], "px"), **dict.fromkeys(LENS[4:], ""), **dict.fromkeys(POSE[:3], "rad"),
    **dict.fromkeys(POSE[3:], "mm"),
}  # fmt: skip
MAP_POINTS = 400  #: samples around a corner that its projector coordinate is read from
LEAST_PRINT = 5e-4  #: scale ratio or shear of a print that is worth a word
LEAST_SAG_MM = 0.02  #: and sag
GROWN = 1.1  #: the measuring volume over what the boards filled


def calibration(
    problem: Problem, fit: Fit, used: Sequence[Sighting], left: tuple[LeftOut, ...], models: tuple[str, ...],
    figures: dict[str, Any], s: CalibrateSettings,
) -> Calibration:  # fmt: skip
    """The solved problem as the world sees it. Uncertainty of a turn is that of a small turn w in exp(w) R."""
    state = fit.state
    solved = sorted({b.pose for b in problem.blocks})
    distance = axis_distance(problem, state, solved)
    T_projector_world = Pose(FACING, np.array([0.0, 0.0, distance]))
    boards = {
        problem.poses[p]: geometry.compose(
            geometry.inverse(T_projector_world), Pose(state.board_R[p], state.board_t[p])
        )
        for p in solved
    }
    rig = _rig(problem, state, T_projector_world, boards)
    H, _ = folded(problem, normal(problem, state, fit.weights))
    inverse, condition = inverse_normal(H)
    parameters, covariance = _parameters(problem, state, T_projector_world, inverse, rig)
    rest, out = _residuals(problem, fit, used)
    told = _figures(problem, fit, used, rig) | figures | {"condition": condition, "steps": fit.steps}
    kept = {b.sighting for b in problem.blocks}
    seen = tuple(n for i, n in enumerate(used) if i in kept)
    suspected = suspected_shape(problem, fit, models, s)
    told["board_shape"] = {name: list(value) for name, value in suspected.items()}
    words = [*_words(problem, parameters, s), *_shape_words(suspected)]
    if words:
        told["words"] = words
    return Calibration(
        rig, problem.board, boards, seen, rest, parameters, covariance, _noise(problem, fit), left + out, told
    )


def axis_distance(problem: Problem, state: State, poses: Sequence[int]) -> float:
    """Where the projector's axis meets the mean board plane, mm from the projector; the boards' mean depth if it hardly
    does.
    """
    middle = np.array([*problem.frame[:2], 0.0])
    points = np.array([state.board_R[p] @ middle + state.board_t[p] for p in poses])
    n, c = np.mean([state.board_R[p][:, 2] for p in poses], axis=0), points.mean(axis=0)
    n = n / max(float(np.linalg.norm(n)), 1e-12)
    d = float(n @ c / n[2]) if abs(n[2]) > 0.3 else np.nan
    return d if 0.5 * c[2] < d < 2 * c[2] else float(c[2])


def _rig(problem: Problem, state: State, T_projector_world: Pose, boards: dict[str, Pose]) -> Rig:
    sizes = problem.sizes

    def lens(d: int) -> Lens:
        fx, fy, cx, cy = state.lens[d, :4]
        return Lens(*sizes.extent(d), np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), state.lens[d, 4:].copy())

    projector = Projector(*sizes.projector, sizes.layout, lens(0), T_projector_world)
    cameras = tuple(
        Camera(name, lens(d), geometry.compose(Pose(state.R[d], state.t[d]), T_projector_world))
        for d, name in enumerate(sizes.cameras, start=1)
    )
    return Rig(projector, cameras, volume_of(problem.board, boards.values()))


def volume_of(board: Board, poses: Any) -> Volume:
    """The box, in the world's axes, that the boards filled, a little larger."""
    w, h = board.inner_corners
    edge = np.array([[i, j] for i in (-1, w) for j in (-1, h)], dtype=np.int32)
    points = np.concatenate([geometry.transform(T, board.corner_mm(edge)) for T in poses])
    low, high = points.min(axis=0), points.max(axis=0)
    half = np.maximum(GROWN * (high - low) / 2, board.square_mm)
    return Volume((low + high) / 2, np.eye(3), half)


def world_jacobian(problem: Problem, state: State, T_projector_world: Pose) -> F64:
    """From unknowns of the solve (projector's frame) to those of the world's frame, which holds the projector fixed."""
    J = np.eye(problem.n_full)
    for d in range(1, len(problem.sizes.devices)):
        at, arm = problem.device_at(d), state.R[d] @ T_projector_world.t
        J[at + 12 : at + 15, at + 9 : at + 12] = -_cross(arm)
    for p in range(len(problem.poses)):
        at = problem.pose_at(p)
        J[at : at + 3, at : at + 3] = T_projector_world.R.T
        J[at + 3 : at + 6, at + 3 : at + 6] = T_projector_world.R.T
    return J


def _cross(v: F64) -> F64:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def _parameters(
    problem: Problem, state: State, T_projector_world: Pose, inverse: F64, rig: Rig
) -> tuple[tuple[Parameter, ...], F64]:
    """Every parameter of devices and board, and the covariance of the free ones followed by six per pose."""
    J = world_jacobian(problem, state, T_projector_world) @ problem.free
    full = J @ inverse @ J.T
    sigma = np.sqrt(np.maximum(np.diag(full), 0))
    free = np.asarray(problem.free.any(axis=1))
    out: list[Parameter] = []
    rows: list[int] = []

    def add(device: str, name: str, value: float, at: int, unit: str) -> None:
        out.append(Parameter(device, name, float(value), float(sigma[at]), unit, not free[at]))
        if free[at]:
            rows.append(at)

    for d, (name, device) in enumerate(zip(problem.sizes.devices, rig.devices, strict=True)):
        at = problem.device_at(d)
        tied = bool(problem.free[at].any() and (problem.free[at] == problem.free[at + 1]).all())
        for k, term in enumerate(LENS):
            if tied and k == 1:
                continue
            add(name, "f" if tied and k == 0 else term, state.lens[d, k], at + k, UNITS[term])
        turn = Rotation.from_matrix(device.pose.R).as_rotvec()
        for k, value in enumerate([*turn, *device.pose.t]):
            add(name, POSE[k], value, at + 9 + k, UNITS[POSE[k]])
    for k, term in enumerate(SHAPE):
        add("board", term, state.shape[k], problem.shape_at + k, "mm" if k < 3 else "")
    for p in sorted({b.pose for b in problem.blocks}):
        rows += range(problem.pose_at(p), problem.pose_at(p) + 6)
    return tuple(out), np.asarray(full[np.ix_(rows, rows)])


# -------------------------------------------------------------------------------------------------- residuals, figures


def _residuals(
    problem: Problem, fit: Fit, used: Sequence[Sighting]
) -> tuple[tuple[Residuals, ...], tuple[LeftOut, ...]]:
    """Residuals per sighting with NaN where left out; words about points left out."""
    corner: dict[int, F64] = {}
    sample: dict[int, tuple[F64, F64]] = {}
    out: list[LeftOut] = []
    for b, w in zip(problem.blocks, fit.weights, strict=True):
        e = evaluate(problem, fit.state, b, derivatives=False)
        r = np.where(w > 0, e.residual, np.nan)
        s = used[b.sighting]
        gone = (w == 0).any(axis=1) & np.isfinite(e.residual).any(axis=1)
        if b.kind == CORNERS:
            corner[b.sighting] = r
            if gone.any():
                far = float(np.max(np.linalg.norm(e.residual[gone], axis=1)))
                out.append(LeftOut(s.pose, s.camera, int(gone.sum()), f"corners up to {far:.2g} px off"))
            continue
        sample[b.sighting] = r, e.uv
        if gone.sum() > 0.01 * len(gone):
            why = f"phases that miss by more than {np.nanmax(np.abs(r)):.2g} units"
            out.append(LeftOut(s.pose, s.camera, int(gone.sum()), why))
    rest = []
    for i in sorted(corner):
        s = used[i]
        none = np.full((len(s.sample_px), len(s.directions)), np.nan), np.full((len(s.sample_px), 2), np.nan)
        r, uv = sample.get(i, none)
        rest.append(Residuals(s.pose, s.camera, corner[i], r, uv))
    return tuple(rest), tuple(out)


def _noise(problem: Problem, fit: Fit) -> dict[str, float]:
    """Standard deviation per camera and kind: the factor times the median of the given sigmas."""
    names = problem.sizes.devices
    out = {}
    for key, factor in sorted(fit.noise.factor.items()):
        sigma = np.concatenate([b.sigma.ravel() for b in problem.blocks if b.key == key])
        out[f"{names[key[0]]} {key[1]} {'px' if key[1] == CORNERS else 'units'}"] = factor * float(np.median(sigma))
    return out


def _figures(problem: Problem, fit: Fit, used: Sequence[Sighting], rig: Rig) -> dict[str, Any]:
    names = problem.sizes.devices
    rms: dict[str, float] = {}
    taken: dict[tuple[int, str], list[F64]] = {}
    for b, w, r in zip(problem.blocks, fit.weights, residuals(problem, fit.state), strict=True):
        taken.setdefault(b.key, []).append(r[w > 0])
    for (d, kind), parts in sorted(taken.items()):
        r = np.concatenate(parts)
        if len(r):
            rms[f"{names[d]} {kind} {'px' if kind == CORNERS else 'units'}"] = float(np.sqrt(np.mean(r * r)))
    detected = sum(len(s.corner) for s in used)
    kept = sum(
        int((w > 0).all(axis=1).sum()) for b, w in zip(problem.blocks, fit.weights, strict=True) if b.kind == CORNERS
    )
    centres = {c.name: geometry.centre(c.pose) for c in rig.cameras}
    origin = geometry.centre(rig.projector.pose)
    stereo, stereo_corners = stereo_rms(problem, fit, used)
    return {
        "poses": len({b.pose for b in problem.blocks}),
        "rms": rms,
        "corners_used": kept,
        "corners_detected": detected,
        "stereo_rms_px": stereo,
        "stereo_corners": stereo_corners,
        "baseline_mm": {n: float(np.linalg.norm(c - origin)) for n, c in centres.items()},
        "sample_worth": {f"{names[d]} {kind}": 1 / e for (d, kind), e in sorted(fit.noise.effect.items())},
    }


def stereo_rms(problem: Problem, fit: Fit, used: Sequence[Sighting]) -> tuple[float, int]:
    """Root mean square distance of corners from where the solution puts them, over both images of each: the camera's,
    and the projector's (phase read at the corner); how many corners it is over.
    """
    total, n = 0.0, 0
    for b, w in zip(problem.blocks, fit.weights, strict=True):
        if b.kind != CORNERS:
            continue
        at = read_at_corners(used[b.sighting], problem.board, b.device, b.pose, b.sighting, every=True)
        if at is None:
            continue
        camera = evaluate(problem, fit.state, b, derivatives=False).residual
        projector = evaluate(problem, fit.state, at, derivatives=False).residual
        ok = (w > 0).all(axis=1) & np.isfinite(projector).all(axis=1)
        total += float(np.sum(camera[ok] ** 2) + np.sum(projector[ok] ** 2))
        n += int(ok.sum())
    return (float(np.sqrt(total / (2 * n))) if n else float("nan")), n


def read_at_corners(
    s: Sighting, board: Board, camera: int, pose: int, number: int, *, every: bool = False
) -> Block | None:
    """The projector's coordinate at corners (see `at_corners`); None without.

    `every` keeps corners without enough samples around, as NaN.
    """
    out, sigma = at_corners(s)
    ok = np.isfinite(out).all(axis=1)
    if not ok.any():
        return None
    keep = np.full(len(out), True) if every else ok
    xy = np.ascontiguousarray(board.corner_mm(s.corner)[keep, :2])
    return Block(PHASE, camera, pose, number, np.ascontiguousarray(out[keep]), np.ascontiguousarray(sigma[keep]), xy)


@lru_cache(maxsize=512)
def at_corners(s: Sighting) -> tuple[F64, F64]:
    """The projector's coordinate (n, 2) at a sighting's corners and its sigma; NaN where too few samples are around.

    By a map of second order, fitted to the samples within a square and a half (after the local homographies of Moreno
    and Taubin 2012, doi:10.1109/3DIMPVT.2012.77).
    """
    out, sigma = np.full((len(s.corner), 2), np.nan), np.full((len(s.corner), 2), np.nan)
    b = sample_block(s, 0, 0, 0)
    if b is None:
        return out, sigma
    rows, uv = projector_coordinates(b)
    if len(rows) < 20:
        return out, sigma
    px = b.place[rows]
    side = _square_px(s)
    for i, c in enumerate(s.corner_px):
        near = np.flatnonzero(np.abs(px - c).max(axis=1) < 1.6 * side)
        near = near[:: max(1, len(near) // MAP_POINTS)]
        fitted = _local(px[near] - c, uv[near]) if len(near) >= 16 else None
        if fitted is not None:
            out[i], sigma[i] = fitted
    return out, sigma


def _square_px(s: Sighting) -> float:
    """Side of a square in pixels, about."""
    span, steps = np.ptp(s.corner_px, axis=0), np.ptp(s.corner, axis=0)
    return float(np.linalg.norm(span)) / max(float(np.linalg.norm(steps)), 1.0)


def _local(d: F64, uv: F64) -> tuple[F64, F64] | None:
    """Value at d = 0 of a second-order fit of uv (n, 2) about there, and its standard deviation (2,)."""
    scale = max(float(np.abs(d).max()), 1e-9)
    x, y = (d / scale).T
    A = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    keep = np.ones(len(x), dtype=bool)
    for _ in range(2):
        N = A[keep].T @ A[keep]
        if keep.sum() < 10 or np.linalg.cond(N) > 1e8:
            return None
        fit = np.linalg.solve(N, A[keep].T @ uv[keep])
        r = np.abs(uv - A @ fit)
        keep = (r <= 4 * NORMAL_MAD * np.median(r[keep], axis=0) + 1e-9).all(axis=1)
    if keep.sum() < 10:
        return None
    spread = np.sqrt(np.sum(r[keep] ** 2, axis=0) / max(keep.sum() - 6, 1))
    return fit[0], np.maximum(spread * np.sqrt(np.linalg.inv(N)[0, 0]), 1e-9)


def suspected_shape(
    problem: Problem, fit: Fit, models: tuple[str, ...], s: CalibrateSettings
) -> dict[str, tuple[float, float]]:
    """What the residuals say of the board's shape, were it free: value and sigma per term, by one step onwards."""
    loose = replace(s, board_shape="bend print", bend_prior_mm=1e3, print_prior=1.0)
    freed = released(problem, models, loose)
    H, g = folded(freed, normal(freed, fit.state, fit.weights))
    inverse, _ = inverse_normal(H)
    at = slice(problem.shape_at, problem.shape_at + len(SHAPE))
    step, sigma = freed.free @ -(inverse @ g), np.sqrt(np.maximum(np.diag(freed.free @ inverse @ freed.free.T), 0))
    value = fit.state.shape + step[at]
    return {n: (float(v), float(e)) for n, v, e in zip(SHAPE, value, sigma[at], strict=True)}


def _shape_words(suspected: dict[str, tuple[float, float]]) -> list[str]:
    """What to say where the board is surely not as described."""
    out = []
    ratio, shear = suspected["ratio"], suspected["shear"]
    if abs(ratio[0]) > max(5 * ratio[1], LEAST_PRINT):
        out.append(
            f"the board's rows stand {100 * ratio[0]:+.2f} % farther apart than its columns: measure the print; "
            'calibrate.board_shape=print allows for it'
        )
    if abs(shear[0]) > max(5 * shear[1], LEAST_PRINT):
        out.append(
            f"the board's columns lean by {np.degrees(shear[0]):.3f} deg against its rows; "
            'calibrate.board_shape=print allows for it'
        )
    sag = max((abs(v) for n, (v, e) in suspected.items() if n.startswith("bend") and abs(v) > 5 * e), default=0.0)
    if sag > LEAST_SAG_MM:
        out.append(f"the board seems bent by {sag:.2g} mm at its corners; calibrate.board_shape=bend allows for it")
    return out


def _words(problem: Problem, parameters: Sequence[Parameter], s: CalibrateSettings) -> list[str]:
    """What is ill-determined, in words."""
    out = []
    by = {(p.device, p.name): p for p in parameters}
    for d, name in enumerate(problem.sizes.devices):
        f = by.get((name, "fx")) or by.get((name, "f"))
        if f is not None and not f.fixed and f.sigma > 0.01 * f.value:
            out.append(
                f"{name}: focal length known to {100 * f.sigma / f.value:.1f} % only; photograph the board tilted by "
                "15 to 30 deg about both its axes, nearer and farther"
            )
        loose = (s.camera_centre_prior if d else s.projector_centre_prior) * max(problem.sizes.extent(d))
        held = [c for c in ("cx", "cy") if not by[name, c].fixed and by[name, c].sigma > 0.5 * loose]
        if held:
            out.append(
                f"{name}: {' and '.join(held)} held by the weak prior only; tilt the board more, and bring it into the "
                "corners"
            )
    return out

