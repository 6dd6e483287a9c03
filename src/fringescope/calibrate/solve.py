"""Sightings of a board to a calibrated rig: start, joint adjustment, what is left out and why, lens, world frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fringescope.calibrate import initial, outcome
from fringescope.calibrate.adjust import (
    NORMAL_MAD,
    USUAL,
    Fit,
    Noise,
    asked_models,
    chosen_models,
    hard_weights,
    known,
    polish,
    released,
    replace_models,
    residuals,
    robust_noise,
    settle,
    shape_terms,
    thinned,
)
from fringescope.calibrate.problem import (
    CORNERS,
    PHASE,
    Block,
    Problem,
    Sizes,
    State,
    centre_block,
    corner_block,
    evaluate,
    minimise,
    sample_block,
)
from fringescope.calibrate.squares import SMALL
from fringescope.errors import CalibrationError, UsageError
from fringescope.settings import CalibrateSettings
from fringescope.types import F64, Board, Calibration, LeftOut, Sighting

COARSE = 120  #: samples of each picture while the solve looks for its way
CHOOSING = 250  #: and while lens models are compared
LEAST_ANGLE = 0.1  #: sine of it: directions of fringes nearer than this tell one coordinate
FEWEST_CORNERS = 6  #: a picture with fewer says too little


def solve(sightings: Sequence[Sighting], board: Board, sizes: Sizes, s: CalibrateSettings | None = None) -> Calibration:
    """Sightings of a board, numbered alike in all cameras of a pose, to a rig with its covariance and residuals.

    One joint adjustment of every lens, device and board pose: corners in camera pixels; phases measured at fixed camera
    pixels, whose rays meet the board, in projector-plane units. World: origin where the projector's axis meets the mean
    board plane, z towards the projector, x along u. Raises CalibrationError for too few, all-parallel or contradicting
    poses, UsageError for settings that cannot mean anything.
    """
    s = s or CalibrateSettings()
    check(s)
    used, left = _able(sightings, sizes)
    problem = make_problem(used, board, sizes, s)
    _two_directions(used)
    _phase_seen(problem, used)
    _enough(problem, s, left)
    focal, pinned = _pins(problem, s)
    coarse = thinned(problem, COARSE)
    start = initial.begin(coarse, focal, pinned)
    state, trusted, out = _agreeing(coarse, start, used, s)
    left += out
    problem = restricted(problem, trusted)
    _enough(problem, s, left)
    _tilted(problem, state, s)
    models, scores = chosen_models(thinned(problem, CHOOSING), state, s)
    fit = _final(problem, state, models, s)
    fit, problem, out = _late(problem, fit, models, used, s)
    _tilted(problem, fit.state, s)
    _believable(problem, fit, s)
    left += out
    figures: dict[str, Any] = {"lens_models": dict(zip(sizes.devices, models, strict=True)), "lens_scores": scores}
    return outcome.calibration(problem, fit, used, tuple(left), models, figures, s)


# --------------------------------------------------------------------------------------------------------- the input


def _able(sightings: Sequence[Sighting], sizes: Sizes) -> tuple[tuple[Sighting, ...], list[LeftOut]]:
    """Sightings that can be used at all, and why the others cannot."""
    used: list[Sighting] = []
    left: list[LeftOut] = []
    for n in sightings:
        if n.camera not in sizes.cameras:
            raise CalibrationError(f"{n.name}: no camera of that name; the session has {', '.join(sizes.cameras)}")
        if tuple(n.size) != tuple(sizes.cameras[n.camera]):
            w, h = sizes.cameras[n.camera]
            why = f"pictures of {n.size[0]} x {n.size[1]}, the camera's others have {w} x {h}: another camera's?"
            left.append(LeftOut(n.pose, n.camera, None, why))
        elif len(n.corner) < FEWEST_CORNERS:
            why = f"{len(n.corner)} corners; needed {FEWEST_CORNERS}"
            left.append(LeftOut(n.pose, n.camera, None, why))
        elif (crooked := _crooked(n)) is not None:
            left.append(LeftOut(n.pose, n.camera, None, crooked))
        else:
            used.append(n)
    names = [n.name for n in used]
    if len(set(names)) != len(names):
        double = next(name for name in names if names.count(name) > 1)
        raise CalibrationError(f"{double} was given twice; needed one sighting of a pose by a camera")
    return tuple(used), left


def _crooked(n: Sighting) -> str | None:
    """Why corners are none of a flat board seen by any camera; None if they may be."""
    found = initial.homography(np.asarray(n.corner, dtype=np.float64), np.asarray(n.corner_px, dtype=np.float64))
    if found is None:
        return "its corners lie on a line; photograph more of the board"
    span = np.sqrt(np.prod(np.ptp(n.corner_px, axis=0)) / max(np.prod(np.ptp(n.corner, axis=0)), 1))
    miss = float(np.median(found[1]))
    return f"corners {miss:.2g} px off a flat grid: numbered wrongly" if miss > 0.15 * span else None


def check(s: CalibrateSettings) -> None:
    """Raises UsageError for settings that cannot mean anything, whatever the pictures show."""
    asked_models(2, s)
    shape_terms(s)
    if s.projector not in ("samples", "centres", "corners"):
        raise UsageError(f"setting projector: '{s.projector}'; needed samples, centres or corners")


def make_problem(used: Sequence[Sighting], board: Board, sizes: Sizes, s: CalibrateSettings) -> Problem:
    """The measurements of sightings as blocks; each block's `sighting` counts `used`."""
    check(s)
    poses = tuple(sorted({n.pose for n in used}))
    names = list(sizes.cameras)
    blocks: list[Block] = []
    for i, n in enumerate(used):
        c, p = names.index(n.camera) + 1, poses.index(n.pose)
        blocks.append(corner_block(n, board, c, p, i))
        options = {
            "samples": lambda n=n, c=c, p=p, i=i: sample_block(n, c, p, i) or centre_block(n, board, c, p, i),
            "centres": lambda n=n, c=c, p=p, i=i: centre_block(n, board, c, p, i),
            "corners": lambda n=n, c=c, p=p, i=i: outcome.read_at_corners(n, board, c, p, i),
        }
        phase = options[s.projector]()
        if phase is not None:
            blocks.append(phase)
    return Problem(board, sizes, poses, tuple(map(_sane, blocks)))


def _sane(b: Block) -> Block:
    """The block with relative sigmas that no single measurement can take over."""
    good = np.isfinite(b.sigma) & (b.sigma > 0)
    middle = float(np.median(b.sigma[good])) if good.any() else 1.0
    return replace(b, sigma=np.ascontiguousarray(np.clip(np.where(good, b.sigma, middle), middle / 4, middle * 20)))


def _pins(problem: Problem, s: CalibrateSettings) -> tuple[dict[int, float], dict[int, tuple[float, float]]]:
    focal, middle = known(problem, s)
    return {d: v[0][0] for d, v in focal.items()}, {d: (v[0][0], v[1][0]) for d, v in middle.items()}


def _enough(problem: Problem, s: CalibrateSettings, left: Sequence[LeftOut]) -> None:
    """Raises CalibrationError where too little is left to be solved."""
    poses = {b.pose for b in problem.blocks}
    why = "; ".join(f"{n.pose}{'/' + n.camera if n.camera else ''}: {n.why}" for n in left[:4])
    if len(poses) < s.min_poses:
        raise CalibrationError(
            f"{len(poses)} usable poses of the board; needed {s.min_poses} at least, eight to ten are good"
            + (f" (left out: {why})" if why else "")
        )
    for c, name in enumerate(problem.sizes.cameras, start=1):
        n = len({b.pose for b in problem.blocks if b.device == c})
        if n < s.min_poses:
            because = f" (left out: {why})" if why else ""
            raise CalibrationError(f"{name} has {n} usable poses of the board; needed {s.min_poses} at least{because}")


def _two_directions(used: Sequence[Sighting]) -> None:
    """Raises CalibrationError where no picture has fringes along two directions."""
    every = [n.directions / np.linalg.norm(n.directions, axis=1, keepdims=True) for n in used if len(n.directions)]
    if every and all(np.abs(g[:, 1] * g[0, 0] - g[:, 0] * g[0, 1]).max() < LEAST_ANGLE for g in every):
        g = every[0][0]
        raise CalibrationError(
            f"fringes along one direction only came ({g[0]:.2f}, {g[1]:.2f}); needed two: project fringes along both "
            "u and v in every pose"
        )


def _phase_seen(problem: Problem, used: Sequence[Sighting]) -> None:
    """Raises CalibrationError where no picture has the projector's phase on the board, with what was said of them."""
    if not used or any(b.kind == PHASE for b in problem.blocks):
        return
    n, words = next(((n, w) for n in used for w in [[w for w in n.words if "white square" in w]] if w), (used[0], []))
    cure = "project fringes along both u and v"
    if any(SMALL in w for w in words):
        cure = "take a board of larger squares, or a lens or place that shows them larger"
    seen = f"{n.name}: {'; '.join(words)}; " if words else ""
    raise CalibrationError(f"no picture has the projector's phase on the board; {seen}{cure}")


def _tilted(problem: Problem, state: State, s: CalibrateSettings) -> None:
    """Raises CalibrationError where the boards do not differ enough to tell focal lengths."""
    poses = sorted({b.pose for b in problem.blocks})
    normals = np.array([state.board_R[p][:, 2] for p in poses])
    apart = float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1, 1))))
    if apart < s.min_tilt_deg:
        raise CalibrationError(
            f"all {len(poses)} poses are parallel within {max(apart, 0.1):.1f} deg; tilt the board by 15 to 30 deg "
            "about both its axes"
        )


def _believable(problem: Problem, fit: Fit, s: CalibrateSettings) -> None:
    """Raises CalibrationError where the solution explains nothing."""
    if (fit.state.lens[0, :2] <= 0).any():
        raise CalibrationError(
            "the projector's phases grow the wrong way along one axis, as in a mirror; turn round the order of the "
            "frames or the sign of cycles_per_pixel of that direction"
        )
    for c, name in enumerate(problem.sizes.cameras, start=1):
        if (fit.state.lens[c, :2] <= 0).any():
            raise CalibrationError(f"{name}: its pictures are mirrored; turn them round")
    for b in problem.blocks:
        miss = fit.noise.factor[b.key] * float(np.median(b.sigma))
        name = problem.sizes.devices[b.device]
        if b.kind == PHASE and miss > s.max_phase_miss * max(problem.sizes.plane):
            raise CalibrationError(
                f"{name}: phases miss any projector by {miss:.2g} units; check that pictures and fringes of a pose "
                "belong together, and the order of the frames"
            )
        if b.kind == CORNERS and miss > s.max_corner_miss * np.sqrt(np.prod(np.ptp(b.place, axis=0)) / len(b.place)):
            raise CalibrationError(
                f"{name}: corners miss any flat board of {problem.board.inner_corners[0]} x "
                f"{problem.board.inner_corners[1]} by {miss:.2g} px; check board.json and that its squares are square"
            )


# -------------------------------------------------------------------------------------------------- what belongs


def restricted(problem: Problem, sightings: frozenset[int] | set[int]) -> Problem:
    """The problem with the blocks of some sightings only."""
    return replace(problem, blocks=tuple(b for b in problem.blocks if b.sighting in sightings))


def _agreeing(
    coarse: Problem, start: initial.Start, used: Sequence[Sighting], s: CalibrateSettings
) -> tuple[State, set[int], list[LeftOut]]:
    """A coarse solve from the sightings that agree, then each sighting judged by it: state, who stays, who goes."""
    state, trusted = start.state, set(start.trusted)
    devices = len(coarse.sizes.devices)
    if start.tilt_spread_deg < s.min_tilt_deg:
        _tilted(restricted(coarse, trusted), state, s)
    out: list[LeftOut] = []
    for turn in range(3):
        part = restricted(coarse, trusted)
        if turn == 0:
            state, _ = settle(released(part, ("none",) * devices, s, centres=False), state, 3, 12)
        models = tuple(USUAL if n == "auto" else n for n in asked_models(devices, s))
        problem, state = replace_models(part, state, models, s)
        state, noise = settle(problem, state, 5 if turn == 0 else 3, 25)
        judged = [judge(coarse, state, noise, n, start.readings.get(n, ())) for n in range(len(used))]
        state, keep, out = verdicts(coarse, state, noise, judged, used, s)
        if keep == trusted:
            break
        trusted = keep
    return state, trusted, out


@dataclass(frozen=True, eq=False)
class Judged:
    """One sighting fitted alone by a rig: its board's pose, rms misfit over noise of corners and of phases (NaN =
    none), and in units.
    """

    R: F64
    t: F64
    corners: float
    phases: float
    corners_px: float
    phases_units: float


def judge(
    problem: Problem, state: State, noise: Noise, sighting: int, readings: Sequence[initial.Reading] = ()
) -> Judged:
    """Fits the pose of one sighting alone, the rig held fixed, from the pose it has and from both its readings."""
    part = restricted(problem, {sighting})
    pose, device = part.blocks[0].pose, part.blocks[0].device
    R, t = state.R[device], state.t[device]
    starts = [(state.board_R[pose], state.board_t[pose])] if np.isfinite(state.board_t[pose]).all() else []
    starts += [(R.T @ r.R, R.T @ (r.t - t)) for r in readings]
    best: tuple[float, Judged] | None = None
    for R0, t0 in starts:
        fitted = fit_pose(part, state, noise, pose, R0, t0)
        if fitted is None:
            continue
        found = residuals(part, fitted)
        z = {b.kind: (_typical(r / noise.spread(b)), _typical(r)) for b, r in zip(part.blocks, found, strict=True)}
        corners, phases = z.get(CORNERS, (np.nan, np.nan)), z.get(PHASE, (np.nan, np.nan))
        j = Judged(fitted.board_R[pose], fitted.board_t[pose], corners[0], phases[0], corners[1], phases[1])
        score = float(np.nansum([corners[0] ** 2, phases[0] ** 2]))
        if best is None or score < best[0]:
            best = score, j
    return best[1] if best else Judged(np.eye(3), np.full(3, np.nan), np.inf, np.inf, np.inf, np.inf)


def _typical(r: F64) -> float:
    """Robust rms of residuals; infinite where most are missing."""
    ok = np.isfinite(r)
    return NORMAL_MAD * float(np.median(np.abs(r[ok]))) if ok.mean() > 0.3 else np.inf


def fit_pose(problem: Problem, state: State, noise: Noise, pose: int, R: F64, t: F64) -> State | None:
    """The state with one board's pose solved from the problem's blocks, the rig held fixed; None if it cannot."""
    board_R, board_t = state.board_R.copy(), state.board_t.copy()
    board_R[pose], board_t[pose] = R, t
    state = replace(state, board_R=board_R, board_t=board_t)
    free = np.zeros((problem.n_full, 6))
    free[problem.pose_at(pose) : problem.pose_at(pose) + 6] = np.eye(6)
    single = replace(problem, free=free, priors={})
    try:
        for limit in (np.inf, 30.0, 8.0):
            found = residuals(single, state)
            own = robust_noise(single, found)
            wide = Noise({k: max(v, noise.factor.get(k, v)) for k, v in own.factor.items()}, noise.effect)
            state, _ = minimise(single, state, hard_weights(single, found, wide, limit), 20, 1e-6)
    except (CalibrationError, np.linalg.LinAlgError):
        return None
    return state


def verdicts(
    problem: Problem, state: State, noise: Noise, judged: Sequence[Judged], used: Sequence[Sighting],
    s: CalibrateSettings,
) -> tuple[State, set[int], list[LeftOut]]:  # fmt: skip
    """Who stays: sightings that fit alone, and of each pose those that agree on where the board is."""
    out: list[LeftOut] = []
    typical = _usual(judged, used)
    good: dict[str, list[int]] = {}
    for n, (j, sighting) in enumerate(zip(judged, used, strict=True)):
        corner_px, phase = typical[sighting.camera]
        bad = []
        if j.corners_px > s.reject_sighting * corner_px:
            bad.append(f"corners {j.corners_px:.2g} px off, others {corner_px:.2g}")
        if j.phases_units > s.reject_sighting * phase:
            why = "the board moved, or another camera's pictures"
            bad.append(f"phases {j.phases_units:.2g} units off, others {phase:.2g}: {why}")
        if bad:
            out.append(LeftOut(sighting.pose, sighting.camera, None, "; ".join(bad)))
        else:
            good.setdefault(sighting.pose, []).append(n)
    keep: set[int] = set()
    board_R, board_t = state.board_R.copy(), state.board_t.copy()
    for p, name in enumerate(problem.poses):
        stay, R, t, gone = _together(problem, state, noise, p, good.get(name, []), judged, used, typical, s)
        keep |= set(stay)
        out += gone
        if stay:
            board_R[p], board_t[p] = R, t
    return replace(state, board_R=board_R, board_t=board_t), keep, out


def _usual(judged: Sequence[Judged], used: Sequence[Sighting]) -> dict[str, tuple[float, float]]:
    """Per camera the median misfit of its sightings: corners in px, phases in units."""
    out = {}
    for camera in {n.camera for n in used}:
        mine = [j for j, n in zip(judged, used, strict=True) if n.camera == camera]
        corner = [j.corners_px for j in mine if np.isfinite(j.corners_px)]
        phase = [j.phases_units for j in mine if np.isfinite(j.phases_units)]
        out[camera] = (
            max(float(np.median(corner)) if corner else np.inf, 1e-6),
            max(float(np.median(phase)) if phase else np.inf, 1e-6),
        )
    return out


def _together(
    problem: Problem, state: State, noise: Noise, pose: int, members: list[int], judged: Sequence[Judged],
    used: Sequence[Sighting], typical: Mapping[str, tuple[float, float]], s: CalibrateSettings,
) -> tuple[list[int], F64, F64, list[LeftOut]]:  # fmt: skip
    """Of the sightings of one pose, those that see the board in one place; the others go by name."""
    gone: list[LeftOut] = []
    stay = list(members)
    while stay:
        leader = max(stay, key=lambda n: len(used[n].corner))
        R, t = judged[leader].R, judged[leader].t
        fitted = fit_pose(restricted(problem, set(stay)), state, noise, pose, R, t)
        misses = {n: _miss(problem, fitted, n, used[n], typical) if fitted else (np.inf, np.inf) for n in stay}
        worst = max(misses.values(), key=lambda m: m[0])[0]
        if fitted is not None and (worst <= s.reject_sighting or len(stay) == 1):
            return stay, fitted.board_R[pose], fitted.board_t[pose], gone
        if len(stay) == 1:
            return [], R, t, gone
        rest = {
            n: _without(problem, state, noise, pose, [m for m in stay if m != n], judged, used, typical) for n in stay
        }
        least = min(rest.values())
        out = min((n for n in stay if rest[n] <= 1.5 * least + 0.1), key=lambda n: len(used[n].corner))
        px = misses[out][1]
        why = f"sees the board elsewhere than other cameras: corners {px:.2g} px off; numbered differently, or moved"
        gone.append(LeftOut(used[out].pose, used[out].camera, None, why))
        stay.remove(out)
    return [], np.eye(3), np.zeros(3), gone


def _without(
    problem: Problem, state: State, noise: Noise, pose: int, stay: list[int], judged: Sequence[Judged],
    used: Sequence[Sighting], typical: Mapping[str, tuple[float, float]],
) -> float:  # fmt: skip
    leader = max(stay, key=lambda n: len(used[n].corner))
    fitted = fit_pose(restricted(problem, set(stay)), state, noise, pose, judged[leader].R, judged[leader].t)
    return max(_miss(problem, fitted, n, used[n], typical)[0] for n in stay) if fitted else np.inf


def _miss(
    problem: Problem, state: State, sighting: int, seen: Sighting, typical: Mapping[str, tuple[float, float]]
) -> tuple[float, float]:
    """How many times worse than usual a sighting's corners or phases fit a state, and its corners' misfit in px."""
    corner_px, phase = typical[seen.camera]
    ratio, px = 0.0, np.nan
    for b in restricted(problem, {sighting}).blocks:
        miss = _typical(evaluate(problem, state, b, derivatives=False).residual)
        ratio = max(ratio, miss / (corner_px if b.kind == CORNERS else phase))
        px = miss if b.kind == CORNERS else px
    return ratio, px


# ------------------------------------------------------------------------------------------------------ the end


def _final(problem: Problem, state: State, models: tuple[str, ...], s: CalibrateSettings) -> Fit:
    coarse, state = replace_models(thinned(problem, CHOOSING), state, models, s)
    state, noise = settle(coarse, state, 2, s.rounds)
    first = polish(coarse, state, noise, s, turns=3)
    full, state = replace_models(problem, first.state, models, s)
    fit = polish(full, state, robust_noise(full, residuals(full, state)), s, turns=2)
    return replace(fit, steps=first.steps + fit.steps)


def _late(
    problem: Problem, fit: Fit, models: tuple[str, ...], used: Sequence[Sighting], s: CalibrateSettings
) -> tuple[Fit, Problem, list[LeftOut]]:
    """Sightings that only the final solve shows to be bad are left out, and it is done again."""
    out: list[LeftOut] = []
    members = {b.sighting for b in problem.blocks}
    found = residuals(problem, fit.state)
    rms = {(b.sighting, b.kind): (_typical(r), b) for b, r in zip(problem.blocks, found, strict=True)}
    keys = {b.key for b in problem.blocks}
    usual = {key: float(np.median([v for v, b in rms.values() if b.key == key])) for key in keys}
    for (n, kind), (v, b) in rms.items():
        if v > s.reject_sighting * max(usual[b.key], 1e-6):
            what, unit = ("corners", "px") if kind == CORNERS else ("phases", "units")
            why = f"{what} {v:.2g} {unit} off, others {usual[b.key]:.2g}"
            out.append(LeftOut(used[n].pose, used[n].camera, None, why))
            members.discard(n)
    if not out:
        return fit, replace_models(problem, fit.state, models, s)[0], out
    less = restricted(problem, members)
    _enough(less, s, out)
    fit = _final(less, fit.state, models, s)
    return fit, replace_models(less, fit.state, models, s)[0], out
