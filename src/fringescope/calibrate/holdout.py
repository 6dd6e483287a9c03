"""Is a rig true for boards that it was not made from? A pose fitted by a rig held fixed; each pose left out in turn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from fringescope import geometry
from fringescope.calibrate import initial, outcome
from fringescope.calibrate.adjust import (
    MODELS,
    NORMAL_MAD,
    Noise,
    design_effects,
    hard_weights,
    released,
    residuals,
    robust_noise,
    thinned,
)
from fringescope.calibrate.problem import CORNERS, SHAPE, Problem, Sizes, State, evaluate, minimise
from fringescope.calibrate.solve import fit_pose, judge, make_problem, restricted
from fringescope.errors import CalibrationError
from fringescope.settings import CalibrateSettings
from fringescope.types import F64, Board, Calibration, Camera, HeldOut, Pose, Residuals, Rig, Sighting

LEAVING = 600  #: samples of each picture while poses are left out


def sizes_of(rig: Rig) -> Sizes:
    """What `solve` asks to know of a rig's devices."""
    p = rig.projector
    return Sizes((p.width, p.height), p.layout, {c.name: (c.lens.width, c.lens.height) for c in rig.cameras})


def state_of(rig: Rig, boards: Mapping[str, Pose], poses: Sequence[str], shape: F64) -> State:
    """A rig and the boards' poses T_world_board as unknowns of the adjustment."""
    T_wp = geometry.inverse(rig.projector.pose)
    relative = [geometry.compose(d.pose, T_wp) for d in rig.devices]
    placed = [geometry.compose(rig.projector.pose, boards[p]) if p in boards else None for p in poses]
    lens = [[d.lens.K[0, 0], d.lens.K[1, 1], d.lens.K[0, 2], d.lens.K[1, 2], *d.lens.distortion] for d in rig.devices]
    return State(
        np.array(lens, dtype=np.float64),
        np.array([T.R for T in relative]),
        np.array([T.t for T in relative]),
        np.array([np.eye(3) if T is None else T.R for T in placed]),
        np.array([[0.0, 0.0, np.nan] if T is None else T.t for T in placed]),
        np.array(shape, dtype=np.float64),
        np.array([d.lens.K[0, 1] for d in rig.devices]),
    )


def fit_board(
    rig: Rig, sightings: Sequence[Sighting], board: Board, s: CalibrateSettings | None = None
) -> tuple[Pose, tuple[Residuals, ...]]:
    """Sightings of one pose by a rig held fixed: T_world_board and what each sighting's measurements miss it by.

    Measurements beyond `reject_sigma` are NaN in the residuals. Raises CalibrationError if there are none, if they are
    of several poses or of cameras that the rig lacks, or if no pose fits.
    """
    s = s or CalibrateSettings()
    known = {c.name for c in rig.cameras}
    mine = tuple(n for n in sightings if n.camera in known and len(n.corner) >= 4)
    if not mine or len({n.pose for n in mine}) != 1:
        poses = len({n.pose for n in mine})
        raise CalibrationError(
            f"{len(mine)} sightings of {poses} poses by cameras of the rig; needed those of one pose"
        )
    problem = make_problem(mine, board, sizes_of(rig), s)
    state = state_of(rig, {}, problem.poses, np.zeros(len(SHAPE)))
    noise = Noise({b.key: 1.0 for b in problem.blocks})
    readings = initial.readings_of(problem, state.lens)
    starts = []
    for n in range(len(mine)):
        j = judge(problem, state, noise, n, readings.get(n, ()))
        if np.isfinite(j.t).all():
            starts.append((j.corners**2 + np.nan_to_num(j.phases) ** 2, n, j))
    for _, _, j in sorted(starts, key=lambda e: e[:2]):
        fitted = fit_pose(problem, state, noise, 0, j.R, j.t)
        if fitted is not None:
            T_world_board = geometry.compose(
                geometry.inverse(rig.projector.pose), Pose(fitted.board_R[0], fitted.board_t[0])
            )
            return T_world_board, _missed(problem, fitted, mine, s)
    raise CalibrationError(f"{mine[0].pose}: no place of the board explains its corners; are they of this rig?")


def _missed(problem: Problem, state: State, mine: Sequence[Sighting], s: CalibrateSettings) -> tuple[Residuals, ...]:
    found = residuals(problem, state)
    weights = hard_weights(problem, found, robust_noise(problem, found), s.reject_sigma)
    corner: dict[int, F64] = {}
    sample: dict[int, tuple[F64, F64]] = {}
    for b, r, w in zip(problem.blocks, found, weights, strict=True):
        kept = np.where(w > 0, r, np.nan)
        if b.kind == CORNERS:
            corner[b.sighting] = kept
        else:
            sample[b.sighting] = kept, evaluate(problem, state, b, derivatives=False).uv
    none = np.zeros((0, 0)), np.zeros((0, 2))
    return tuple(Residuals(n.pose, n.camera, corner[i], *sample.get(i, none)) for i, n in enumerate(mine))


def leave_one_out(calibration: Calibration, s: CalibrateSettings | None = None) -> tuple[HeldOut, ...]:
    """Each pose left out in turn: the rig solved from the others, then only that pose's board fitted.

    Starts from the solution; lens models and noise stay. A pose without which the others cannot be solved is passed
    over.
    """
    s = s or CalibrateSettings()
    rig, board, used = calibration.rig, calibration.board, calibration.sightings
    problem = thinned(make_problem(used, board, sizes_of(rig), s), LEAVING)
    shape = np.array([p.value for p in calibration.parameters if p.device == "board"] or np.zeros(len(SHAPE)))
    state = state_of(rig, calibration.boards, problem.poses, shape)
    problem = released(problem, _models(calibration), s)
    found = residuals(problem, state)
    noise = robust_noise(problem, found)
    weights = hard_weights(problem, found, noise, s.reject_sigma)
    noise = Noise(noise.factor, design_effects(problem, state, weights, noise))
    weights = hard_weights(problem, found, noise, s.reject_sigma)
    if len(problem.poses) <= s.min_poses:
        return ()
    out = []
    for p in range(len(problem.poses)):
        stay = [i for i, b in enumerate(problem.blocks) if b.pose != p]
        part = released(replace(problem, blocks=tuple(problem.blocks[i] for i in stay)), _models(calibration), s)
        try:
            solved, _ = minimise(part, state, [weights[i] for i in stay], s.rounds, 1e-7)
        except (CalibrationError, np.linalg.LinAlgError):
            continue
        one = restricted(problem, {b.sighting for b in problem.blocks if b.pose == p})
        fitted = fit_pose(one, solved, noise, p, state.board_R[p], state.board_t[p])
        if fitted is not None:
            out.append(_judged(calibration, one, fitted, p))
    return tuple(out)


def _models(calibration: Calibration) -> tuple[str, ...]:
    """The lens model of every device, from which of its terms were free."""
    out = []
    for name in ("projector", *(c.name for c in calibration.rig.cameras)):
        free = {p.name for p in calibration.parameters if p.device == name and not p.fixed}
        terms = tuple(k for k, t in enumerate(("k1", "k2", "p1", "p2", "k3")) if t in free)
        out.append(next((m for m, k in MODELS.items() if k == terms), "none"))
    return tuple(out)


def _judged(calibration: Calibration, one: Problem, state: State, pose: int) -> HeldOut:
    """What the rig of the other poses says of this one."""
    rig = rig_of(calibration.rig, state)
    px, units, um = [], [], []
    measured, true = [], []
    for b in one.blocks:
        e = evaluate(one, state, b, derivatives=False)
        r = e.residual
        seen = calibration.sightings[b.sighting]
        camera = rig.camera(seen.camera)
        if b.kind == CORNERS:
            keep = np.isfinite(_kept(calibration, seen)).all(axis=1)
            px.append(r[keep].ravel())
            points = triangulated_corners(rig, camera, seen, calibration.board)
            ok = keep & np.isfinite(points).all(axis=1)
            measured.append(points[ok])
            true.append(calibration.board.corner_mm(seen.corner)[ok])
        else:
            z = NORMAL_MAD * np.nanmedian(np.abs(r))
            r = np.where(np.abs(r) < 5 * z, r, np.nan)
            units.append(r.ravel())
            if not b.points:
                um.append(1e3 * _along_ray(rig, camera, b.place, b.g, e.board_xy, r, state, pose))
    A, B = np.concatenate(true), np.concatenate(measured)
    rms, scale = _rigid(A, B)
    return HeldOut(one.poses[pose], len(A), rms, _rms(px), _rms(units), _rms(um), scale)


def rig_of(rig: Rig, state: State) -> Rig:
    """A rig with the lenses and poses of a state; its projector stays where it is."""
    cameras = []
    for d, c in enumerate(rig.cameras, start=1):
        fx, fy, cx, cy = state.lens[d, :4]
        K = np.array([[fx, state.skew[d], cx], [0, fy, cy], [0, 0, 1]])
        lens = replace(c.lens, K=K, distortion=state.lens[d, 4:])
        cameras.append(Camera(c.name, lens, geometry.compose(Pose(state.R[d], state.t[d]), rig.projector.pose)))
    fx, fy, cx, cy = state.lens[0, :4]
    p = rig.projector
    lens = replace(p.lens, K=np.array([[fx, state.skew[0], cx], [0, fy, cy], [0, 0, 1]]), distortion=state.lens[0, 4:])
    return Rig(replace(p, lens=lens), tuple(cameras), rig.volume)


def _kept(calibration: Calibration, seen: Sighting) -> F64:
    """The calibration's residuals of a sighting's corners; NaN = left out."""
    for r in calibration.residuals:
        if (r.pose, r.camera) == (seen.pose, seen.camera):
            return r.corner
    return np.full((len(seen.corner), 2), np.nan)


def triangulated_corners(rig: Rig, camera: Camera, seen: Sighting, board: Board) -> F64:
    """World points (n, 3), mm, midway between the camera's and the projector's rays through each corner; NaN = none."""
    b = outcome.read_at_corners(seen, board, 1, 0, 0, every=True)
    if b is None:
        return np.full((len(seen.corner), 3), np.nan)
    a0, a = geometry.world_rays(camera, seen.corner_px)
    c0, c = geometry.world_rays(rig.projector, b.place)
    w = c0 - a0
    ac, aw, cw = (a * c).sum(-1), a @ w, c @ w
    det = 1 - ac**2
    s, t = (aw - ac * cw) / det, (ac * aw - cw) / det
    return np.asarray((a0 + s[:, None] * a + c0 + t[:, None] * c) / 2)


def _along_ray(
    rig: Rig, camera: Camera, px: F64, g: F64, board_xy: F64, r: F64, state: State, pose: int
) -> F64:
    """Residuals (k, d) of phase as distances along the camera's rays, mm (k,): what all directions say together."""
    on_board = np.column_stack([board_xy, np.zeros(len(px))])
    back = geometry.inverse(rig.projector.pose)
    points = geometry.transform(back, on_board @ state.board_R[pose].T + state.board_t[pose])
    _, ray = geometry.world_rays(camera, px)
    step = 1e-3
    slope = (geometry.project(rig.projector, points + step * ray) - geometry.project(rig.projector, points)) / step
    along = slope @ (g / np.linalg.norm(g, axis=1)[:, None]).T
    ok = np.isfinite(r)
    top, bottom = np.sum(np.where(ok, along * r, 0), axis=1), np.sum(np.where(ok, along**2, 0), axis=1)
    return np.asarray(np.where(bottom > 0, top / np.where(bottom > 0, bottom, 1), np.nan))


def _rms(parts: Sequence[F64]) -> float:
    r = np.concatenate([np.zeros(0), *parts])
    r = r[np.isfinite(r)]
    return float(np.sqrt(np.mean(r * r))) if len(r) else float("nan")


def _rigid(A: F64, B: F64) -> tuple[float, float]:
    """Rms distance of B (n, 3) from A moved rigidly onto it, and the scale of B over A (Umeyama 1991)."""
    if len(A) < 4:
        return float("nan"), float("nan")
    T, scale = geometry.similarity(A, B)
    rest = B - geometry.transform(T, A)
    return float(np.sqrt(np.mean(np.sum(rest**2, axis=1)))), scale

