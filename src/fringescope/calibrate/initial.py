"""Where the joint adjustment begins, from nothing but the sizes of sensors and projector (III-B).

Lenses are long and fields narrow, so a board's tilt has two readings in each picture that perspective barely tells
apart. Each camera alone gives a focal length (principal point in the middle, square pixels) and both readings of each
pose; the projector, which need not be square nor centred, then follows from the points in the camera's frame by the
direct linear transform, and the readings are those for which one projector explains all poses.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fringescope.calibrate.problem import CORNERS, Block, Problem, State
from fringescope.errors import CalibrationError
from fringescope.types import F64

FOCAL_STARTS = (0.6, 1.0, 1.7, 3.0, 5.0, 9.0, 16.0, 30.0)  #: focal lengths that are tried, in widths of the picture
POINTS = 60  #: corners or samples of a picture that the start looks at
PAIRS = 60  #: pairs of poses that are tried as a projector's


@dataclass(frozen=True, eq=False)
class Reading:
    """One of the two poses T_camera_board that a picture of a flat board allows, and its reprojection error."""

    R: F64
    t: F64
    error_px: float


@dataclass(frozen=True, eq=False)
class Seen:
    """What the start uses of one sighting: corners, camera pixels with projector coordinates, both readings."""

    camera: int
    pose: int
    sighting: int
    xy: F64
    px: F64
    at: F64
    uv: F64
    readings: tuple[Reading, ...] = ()


@dataclass(frozen=True, eq=False)
class Start:
    """A state to begin with and the sightings that agreed with it (by number)."""

    state: State
    trusted: frozenset[int]
    tilt_spread_deg: float
    readings: dict[int, tuple[Reading, ...]]  #: both readings T_camera_board of every sighting


def begin(problem: Problem, focal: dict[int, float], pinned: dict[int, tuple[float, float]]) -> Start:
    """A state from corners and phases alone; `focal` and `pinned` (principal point) per device where they are known.

    Raises CalibrationError if no camera can be tied to the projector.
    """
    seen = [s for s in _gather(problem) if s is not None]
    _same_handed(problem, seen)
    lenses = {c: _camera(problem, c, seen, focal.get(c), pinned.get(c)) for c in sorted({s.camera for s in seen})}
    seen = [_with_readings(s, lenses[s.camera]) for s in seen]
    by_camera = {c: [s for s in seen if s.camera == c] for c in lenses}
    tied = {c: _tie(problem, by_camera[c], lens, focal.get(0), pinned.get(0)) for c, lens in lenses.items()}
    found = {c: t for c, t in tied.items() if t is not None}
    if not found:
        raise CalibrationError(
            "no camera and the projector agree on any two poses; check that every pose's pictures and fringes belong "
            "together, and tilt the board between poses"
        )
    best = min(found, key=lambda c: found[c].score / max(len(found[c].chosen), 1) - len(found[c].chosen))
    return _assemble(problem, lenses, seen, found, best)


def _same_handed(problem: Problem, seen: Sequence[Seen]) -> None:
    """Raises CalibrationError where one of camera and projector, which both face the board, sees it as in a mirror."""
    for c in sorted({s.camera for s in seen}):
        turns = [np.linalg.det(_slope(s.at, s.uv)) > 0 for s in seen if s.camera == c and len(s.uv) >= 6]
        if turns and np.mean(turns) < 0.5:
            raise CalibrationError(
                f"{problem.sizes.devices[c]}: the projector's phases grow the wrong way along one axis, as in a "
                "mirror; turn round the order of the frames or the sign of cycles_per_pixel of one direction"
            )


def _slope(px: F64, uv: F64) -> F64:
    """The linear part (2, 2) of the best affine map of px (n, 2) to uv (n, 2)."""
    fit, *_ = np.linalg.lstsq(np.column_stack([px - px.mean(axis=0), np.ones(len(px))]), uv, rcond=None)
    return np.asarray(fit[:2])


def readings_of(problem: Problem, lens: F64) -> dict[int, tuple[Reading, ...]]:
    """Both readings of every sighting under known lenses (D, 9)."""
    return {s.sighting: _with_readings(s, lens[s.camera]).readings for s in _gather(problem) if s is not None}


def homography(xy: F64, px: F64) -> tuple[F64, F64] | None:
    """Map of the board to the picture (3, 3) and the distances (n,) of the corners from it; None if there is none."""
    try:
        H, _ = cv2.findHomography(xy, px, cv2.LMEDS if len(xy) > 12 else 0)
        if H is not None and len(xy) > 12:
            near = _from_map(H, xy, px)
            keep = near <= max(4 * float(np.median(near)), 1e-9)
            H, _ = cv2.findHomography(xy[keep], px[keep], 0)
    except cv2.error:
        return None
    return None if H is None else (np.asarray(H), _from_map(H, xy, px))


def _from_map(H: F64, xy: F64, px: F64) -> F64:
    q = np.column_stack([xy, np.ones(len(xy))]) @ H.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.linalg.norm(q[:, :2] / q[:, 2:] - px, axis=1))


def _spread(n: int, most: int) -> NDArray[np.intp]:
    """At most `most` of n numbers, evenly."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(np.intp))


def projector_coordinates(b: Block) -> tuple[NDArray[np.intp], F64]:
    """Rows of a block of samples that two directions at least were measured at, and (u, v) there (n, 2)."""
    if b.points:
        return np.arange(len(b.place)), b.place
    ok = np.isfinite(b.cycles)
    full = np.flatnonzero(ok.all(axis=1))
    if len(b.g) < 2 or not len(full) or np.linalg.matrix_rank(b.g / np.linalg.norm(b.g, axis=1)[:, None], tol=1e-3) < 2:
        return np.zeros(0, dtype=np.intp), np.zeros((0, 2))
    return full, np.asarray(b.cycles[full] @ np.linalg.pinv(b.g).T)


def _gather(problem: Problem) -> list[Seen | None]:
    blocks: dict[int, list[Block]] = {}
    for b in problem.blocks:
        blocks.setdefault(b.sighting, []).append(b)
    return [_seen(n, bs) for n, bs in blocks.items()]


def _seen(number: int, blocks: Sequence[Block]) -> Seen | None:
    corners = next((b for b in blocks if b.kind == CORNERS), None)
    if corners is None or len(corners.xy) < 6:
        return None
    found = homography(corners.xy, corners.place)
    if found is None:
        return None
    H, away = found
    ok = np.flatnonzero(away <= max(6 * float(np.median(away)), 1e-6))
    ok = ok[_spread(len(ok), 2 * POINTS)]
    at, uv = np.zeros((0, 2)), np.zeros((0, 2))
    for b in blocks:
        if b.kind == CORNERS:
            continue
        rows, where = projector_coordinates(b)
        pick = _spread(len(rows), POINTS) if len(rows) else np.zeros(0, dtype=np.intp)
        at, uv = b.place[rows[pick]], where[pick]
        if b.points:  # measured at board points: their pixels by the map
            q = np.column_stack([b.xy[rows[pick]], np.ones(len(pick))]) @ H.T
            at = q[:, :2] / q[:, 2:]
    return Seen(corners.device, corners.pose, number, corners.xy[ok], corners.place[ok], at, uv)


# ------------------------------------------------------------------------------------------------------- one camera

_FIX_K = cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
_MONO = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO | _FIX_K


def _camera(
    problem: Problem, camera: int, seen: Sequence[Seen], focal: float | None, middle: tuple[float, float] | None
) -> F64:
    """Nine numbers of a camera's lens from its corners alone: square pixels, centred, k1."""
    size = problem.sizes.extent(camera)
    mine = [s for s in seen if s.camera == camera]
    objects = [np.column_stack([s.xy, np.zeros(len(s.xy))]).astype(np.float32)[:, None] for s in mine]
    pictures = [s.px.astype(np.float32)[:, None] for s in mine]
    cx, cy = middle or ((size[0] - 1) / 2, (size[1] - 1) / 2)
    starts = [focal] if focal else [f * max(size) for f in FOCAL_STARTS]

    def fit(f: float, flags: int) -> tuple[float, float, float]:
        K = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1.0]])
        try:
            e, K, d, *_ = cv2.calibrateCamera(objects, pictures, size, K, np.zeros(5), flags=_MONO | flags)
        except cv2.error:
            return np.inf, f, 0.0
        sane = np.isfinite(e) and 0.2 * max(size) < K[0, 0] < 200 * max(size)
        return (float(e), float(K[0, 0]), float(np.ravel(d)[0])) if sane else (np.inf, f, 0.0)

    held = [fit(f, cv2.CALIB_FIX_FOCAL_LENGTH) for f in starts]
    error, f, k1 = min(held)
    if not focal:
        error, f, k1 = min([fit(f, 0), (error, f, k1)], key=lambda e: e[0])
    if not np.isfinite(error):
        f, k1 = 4.0 * max(size), 0.0
    return np.array([f, f, cx, cy, k1, 0, 0, 0, 0])


def _with_readings(s: Seen, lens: F64) -> Seen:
    n = _ideal(s.px, lens)
    xyz = np.column_stack([s.xy, np.zeros(len(s.xy))])
    middle = xyz.mean(axis=0)
    try:
        _, rs, ts, _ = cv2.solvePnPGeneric(xyz - middle, n, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    except cv2.error:
        return s
    out = []
    for r, t in zip(rs, ts, strict=True):
        r, t = cv2.solvePnPRefineLM(xyz - middle, n, np.eye(3), np.zeros(5), r.copy(), t.copy())
        q, _ = cv2.projectPoints(xyz - middle, r, t, np.eye(3), np.zeros(5))
        R = cv2.Rodrigues(r)[0]
        error = lens[0] * float(np.sqrt(np.mean(np.sum((q.reshape(-1, 2) - n) ** 2, axis=1))))
        if np.isfinite(error) and t[2, 0] > 0:
            out.append(Reading(R, t.ravel() - R @ middle, error))
    return Seen(s.camera, s.pose, s.sighting, s.xy, s.px, s.at, s.uv, tuple(sorted(out, key=lambda e: e.error_px)))


def _ideal(px: F64, lens: F64) -> F64:
    K = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
    return np.asarray(cv2.undistortPoints(px[:, None].astype(np.float64), K, lens[4:9])).reshape(-1, 2)


def _points(s: Seen, reading: Reading, lens: F64) -> F64:
    """Where the rays of `at` meet the board, camera frame, mm (n, 3)."""
    rays = np.column_stack([_ideal(s.at, lens), np.ones(len(s.at))]) if len(s.at) else np.zeros((0, 3))
    n = reading.R[:, 2]
    return np.asarray(rays * ((n @ reading.t) / (rays @ n))[:, None])


# --------------------------------------------------------------------------------------------------- the projector


@dataclass(frozen=True, eq=False)
class Tie:
    """The projector in one camera's frame: four numbers of its lens, T_projector_camera, the readings that fit."""

    lens: F64
    R: F64
    t: F64
    chosen: dict[int, int]  #: sighting number -> which reading
    score: float


def _tie(
    problem: Problem, seen: Sequence[Seen], lens: F64, focal: float | None, middle: tuple[float, float] | None
) -> Tie | None:
    """The projector that explains most poses of one camera; None if there are fewer than two with phases."""
    able = [s for s in seen if s.readings and len(s.uv) >= 6]
    if len(able) < 2:
        return None
    points = {(s.sighting, k): _points(s, r, lens) for s in able for k, r in enumerate(s.readings)}
    uvs = {s.sighting: s.uv for s in able}
    options = {s.sighting: range(len(s.readings)) for s in able}
    reading_px = {(s.sighting, k): r.error_px for s in able for k, r in enumerate(s.readings)}
    best: tuple[float, F64] | None = None
    for a, b in _pairs(able):
        for ka, kb in itertools.product(options[a], options[b]):
            P = _direct(np.vstack([points[a, ka], points[b, kb]]), np.vstack([uvs[a], uvs[b]]))
            if P is None:
                continue
            score, _ = _judge(P, points, uvs, options, reading_px)
            if best is None or score < best[0]:
                best = score, P
    if best is None:
        return None
    P = best[1]
    chosen: dict[int, int] = {}
    for _ in range(4):
        _, errors = _judge(P, points, uvs, options, reading_px)
        limit = 4 * float(np.median([e for e, _ in errors.values()])) + 1e-6
        chosen = {n: k for n, (e, k) in errors.items() if e <= limit}
        again = _direct(np.vstack([points[n, k] for n, k in chosen.items()]), np.vstack([uvs[n] for n in chosen]))
        if again is None:
            break
        P = again
    xyz = np.vstack([points[n, k] for n, k in chosen.items()])
    uv = np.vstack([uvs[n] for n in chosen])
    fitted = _inverse_camera(problem.sizes.plane, P, xyz, uv, focal, middle)
    if fitted is None:
        return None
    intrinsics, R, t, error = fitted
    return Tie(intrinsics, R, t, chosen, error)


def _pairs(able: Sequence[Seen]) -> list[tuple[int, int]]:
    """Pairs of sightings, those whose normals differ most first."""
    pairs = list(itertools.combinations(able, 2))
    pairs.sort(key=lambda p: float(p[0].readings[0].R[:, 2] @ p[1].readings[0].R[:, 2]))
    return [(a.sighting, b.sighting) for a, b in pairs[:PAIRS]]


def _judge(
    P: F64, points: dict[tuple[int, int], F64], uvs: dict[int, F64], options: dict[int, range],
    reading_px: dict[tuple[int, int], float],
) -> tuple[float, dict[int, tuple[float, int]]]:  # fmt: skip
    """How badly a projector matrix explains the poses: score, and per sighting its median error with which reading."""
    out: dict[int, tuple[float, int]] = {}
    for n, ks in options.items():
        errors = []
        for k in ks:
            q = np.column_stack([points[n, k], np.ones(len(uvs[n]))]) @ P.T
            with np.errstate(divide="ignore", invalid="ignore"):
                away = np.linalg.norm(q[:, :2] / q[:, 2:] - uvs[n], axis=1)
            errors.append((float(np.median(away)), k) if np.isfinite(away).all() else (1e9, k))
        out[n] = min(errors)
    extra = sum(np.log1p((reading_px[n, k] / (reading_px[n, 0] + 0.02)) ** 2) for n, (_, k) in out.items())
    return float(sum(np.log1p(e * e) for e, _ in out.values()) + 0.5 * extra), out


def _direct(xyz: F64, uv: F64) -> F64 | None:
    """The 3 x 4 matrix that maps points (n, 3) to (u, v), by the direct linear transform with normalised coordinates.

    Hartley and Zisserman, Multiple View Geometry, 2nd edition, section 7.1.
    """
    m3, m2 = xyz.mean(axis=0), uv.mean(axis=0)
    s3 = np.sqrt(3) / max(float(np.sqrt(((xyz - m3) ** 2).sum(1).mean())), 1e-12)
    s2 = np.sqrt(2) / max(float(np.sqrt(((uv - m2) ** 2).sum(1).mean())), 1e-12)
    X = np.column_stack([(xyz - m3) * s3, np.ones(len(xyz))])
    x = (uv - m2) * s2
    zero = np.zeros_like(X)
    A = np.vstack([np.hstack([X, zero, -x[:, :1] * X]), np.hstack([zero, X, -x[:, 1:] * X])])
    value, vector = np.linalg.eigh(A.T @ A)
    if value[1] < 1e-14 * value[-1]:
        return None
    T3, T2 = np.diag([s3, s3, s3, 1.0]), np.diag([s2, s2, 1.0])
    T3[:3, 3], T2[:2, 2] = -s3 * m3, -s2 * m2
    P = np.linalg.inv(T2) @ vector[:, 0].reshape(3, 4) @ T3
    return np.asarray(P * np.sign(np.median(np.column_stack([xyz, np.ones(len(xyz))]) @ P[2])))


def _inverse_camera(
    plane: tuple[int, int], P: F64, xyz: F64, uv: F64, focal: float | None, middle: tuple[float, float] | None
) -> tuple[F64, F64, F64, float] | None:
    """fx, fy, cx, cy, T_projector_camera and rms error of the best projector near a matrix or a plain guess."""
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K1 | _FIX_K
    objects, pictures = [xyz.astype(np.float32)[:, None]], [uv.astype(np.float32)[:, None]]
    best: tuple[float, F64, F64, F64] | None = None
    for K, fixed in _guesses(plane, P, focal, middle):
        try:
            e, K, _, r, t = cv2.calibrateCamera(objects, pictures, plane, K.copy(), np.zeros(5), flags=flags | fixed)
        except cv2.error:
            continue
        depth = (xyz @ cv2.Rodrigues(r[0])[0].T + t[0].ravel())[:, 2]
        if not np.isfinite(e) or not (depth > 0).all() or not (0.1 * max(plane) < K[0, 0] < 200 * max(plane)):
            continue
        if best is None or e < 0.7 * best[0]:
            best = float(e), np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]), cv2.Rodrigues(r[0])[0], t[0].ravel()
    return None if best is None else (best[1], best[2], best[3], best[0])


def _guesses(
    plane: tuple[int, int], P: F64, focal: float | None, middle: tuple[float, float] | None
) -> list[tuple[F64, int]]:
    """Matrices K to start from, and what stays fixed with each."""
    out: list[tuple[F64, int]] = []
    K, *_ = cv2.decomposeProjectionMatrix(P)
    K = K / K[2, 2]
    aspect = abs(K[1, 1] / K[0, 0]) if K[0, 0] else 1.0
    if (
        0.1 * max(plane) < abs(K[0, 0]) < 100 * max(plane) and 0.2 < aspect < 5
        and abs(K[0, 2]) < 5 * plane[0] and abs(K[1, 2]) < 5 * plane[1]
    ):  # fmt: skip
        out.append((np.array([[abs(K[0, 0]), 0, K[0, 2]], [0, abs(K[1, 1]), K[1, 2]], [0, 0, 1]]), 0))
    cx, cy = middle or ((plane[0] - 1) / 2, (plane[1] - 1) / 2)
    pin = cv2.CALIB_FIX_PRINCIPAL_POINT
    for f in [focal] if focal else [w * max(plane) for w in (1.0, 2.0, 4.0, 8.0)]:
        for a in (1.0, 2.0, 0.5):
            guess = np.array([[f, 0, cx], [0, a * f, cy], [0, 0, 1]])
            out += [(guess, pin | (cv2.CALIB_FIX_FOCAL_LENGTH if focal else 0))] + ([] if middle else [(guess, 0)])
    return out


# --------------------------------------------------------------------------------------------------- all together


def _assemble(
    problem: Problem, lenses: dict[int, F64], seen: Sequence[Seen], found: dict[int, Tie], best: int
) -> Start:
    D, P = len(problem.sizes.devices), len(problem.poses)
    lens, R, t = np.zeros((D, 9)), np.tile(np.eye(3), (D, 1, 1)), np.zeros((D, 3))
    main = found[best]
    lens[0, :4] = main.lens
    trusted: set[int] = set()
    boards: dict[int, list[tuple[float, F64, F64]]] = {}
    for c in range(1, D):
        lens[c] = lenses.get(c, np.array([*[max(problem.sizes.extent(c)) * 4.0] * 2, 0, 0, 0, 0, 0, 0, 0]))
        if c not in found:
            continue
        tie = found[c]
        mine = {s.sighting: s for s in seen if s.camera == c}
        Rpc, tpc = (tie.R, tie.t) if c == best else _resect(main.lens, tie, mine, lenses[c])
        R[c], t[c] = Rpc.T, -Rpc.T @ tpc
        for n, k in tie.chosen.items():
            trusted.add(n)
            r = mine[n].readings[k]
            boards.setdefault(mine[n].pose, []).append(((c != best) + r.error_px, Rpc @ r.R, Rpc @ r.t + tpc))
    _link(seen, found, boards, R, t, trusted)
    board_R, board_t = np.tile(np.eye(3), (P, 1, 1)), np.tile([0.0, 0.0, np.nan], (P, 1))
    for p, options in boards.items():
        _, board_R[p], board_t[p] = min(options, key=lambda o: o[0])
    normals = np.array([board_R[p][:, 2] for p in boards])
    readings = {s.sighting: s.readings for s in seen}
    state = State(lens, R, t, board_R, board_t, np.zeros(5), np.zeros(D))
    return Start(state, frozenset(trusted), _widest(normals), readings)


def _widest(normals: F64) -> float:
    """The largest angle between two boards, degrees."""
    return float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1, 1)))) if len(normals) else 0.0


def _resect(lens: F64, tie: Tie, mine: dict[int, Seen], camera: F64) -> tuple[F64, F64]:
    """T_projector_camera of a camera, with another camera's idea of the projector's lens."""
    xyz = np.vstack([_points(mine[n], mine[n].readings[k], camera) for n, k in tie.chosen.items()])
    uv = np.vstack([mine[n].uv for n in tie.chosen])
    K = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
    try:
        ok, r, t = cv2.solvePnP(xyz, uv, K, None, cv2.Rodrigues(tie.R)[0], tie.t[:, None].copy(), True)
    except cv2.error:
        return tie.R, tie.t
    return (cv2.Rodrigues(r)[0], t.ravel()) if ok and t[2, 0] > 0 else (tie.R, tie.t)


def _link(
    seen: Sequence[Seen], found: dict[int, Tie], boards: dict[int, list[tuple[float, F64, F64]]], R: F64, t: F64,
    trusted: set[int],
) -> None:  # fmt: skip
    """Cameras that measured no phases hang on poses that others have placed: the reading that most poses agree on."""
    waiting = sorted({s.camera for s in seen} - set(found))
    for c in waiting:
        options = []
        for s in seen:
            if s.camera == c and s.pose in boards and s.readings:
                _, Rpb, tpb = min(boards[s.pose], key=lambda o: o[0])
                options += [(s.sighting, r.R @ Rpb.T, r.t - r.R @ Rpb.T @ tpb) for r in s.readings]
        if not options:
            continue
        turns = np.array([o[1] for o in options])
        apart = np.arccos(np.clip((np.einsum("aij,bij->ab", turns, turns) - 1) / 2, -1, 1))
        winner = int(np.argmin(np.sum(np.minimum(apart, 0.2), axis=1)))
        R[c], t[c] = options[winner][1], options[winner][2]
        trusted |= {options[i][0] for i in np.flatnonzero(apart[winner] < 0.1)}
