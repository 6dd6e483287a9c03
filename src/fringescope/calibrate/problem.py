"""The joint adjustment as a problem of least squares: what is measured, what is unknown, residuals, normal equations,
and steps of Levenberg and Marquardt. The projector's frame is the reference while it is solved.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from fringescope.errors import CalibrationError
from fringescope.kernels import adjust as kernel
from fringescope.types import F64, I32, Board, Layout, Sighting, plane_size

LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
POSE = ("rx", "ry", "rz", "tx", "ty", "tz")
SHAPE = ("bend xx", "bend xy", "bend yy", "ratio", "shear")
DEVICE = len(LENS) + len(POSE)  #: unknowns of a device in the full vector
CORNERS, PHASE = "corners", "projector"  #: kinds of measurement


@dataclass(frozen=True)
class Sizes:
    """What is known before anything is seen: the projector's pixels and layout, each camera's name and pixels."""

    projector: tuple[int, int]
    layout: Layout
    cameras: Mapping[str, tuple[int, int]]

    @property
    def plane(self) -> tuple[int, int]:
        """Extent of the projector plane in its units."""
        return plane_size(*self.projector, self.layout)

    @property
    def devices(self) -> tuple[str, ...]:
        """Names: the projector, then the cameras."""
        return ("projector", *self.cameras)

    def extent(self, device: int) -> tuple[int, int]:
        """Width and height of device 0 (the projector's plane) or of a camera, 1 .."""
        return self.plane if device == 0 else list(self.cameras.values())[device - 1]


@dataclass(frozen=True, eq=False)
class State:
    """All unknowns: lens (D, 9), T_device_projector (D: R (D, 3, 3), t (D, 3)), T_projector_board (P), shape (5,).

    `skew` (D,) belongs to rigs of others; it is never solved for.
    """

    lens: F64
    R: F64
    t: F64
    board_R: F64  # noqa: N815
    board_t: F64
    shape: F64
    skew: F64

    def moved(self, step: F64) -> State:
        """The state after a step in the full vector: devices of 15, shape of 5, boards of 6."""
        D, P = len(self.lens), len(self.board_t)
        device = step[: D * DEVICE].reshape(D, DEVICE)
        board = step[D * DEVICE + len(SHAPE) :].reshape(P, 6)
        turn = Rotation.from_rotvec(device[:, 9:12]).as_matrix()
        board_turn = Rotation.from_rotvec(board[:, :3]).as_matrix() if P else np.zeros((0, 3, 3))
        return State(
            self.lens + device[:, :9],
            turn @ self.R,
            self.t + device[:, 12:],
            board_turn @ self.board_R,
            self.board_t + board[:, 3:],
            self.shape + step[D * DEVICE : D * DEVICE + len(SHAPE)],
            self.skew,
        )

    def lens_ten(self, device: int) -> F64:
        """The ten numbers of a device's lens that kernels take."""
        lens = self.lens[device]
        return np.concatenate([lens[:4], self.skew[device : device + 1], lens[4:]])


@dataclass(frozen=True, eq=False)
class Block:
    """The measurements of one kind of one sighting, as kernels take them.

    kind CORNERS: points `xy` (n, 2) mm of the board at `place` (n, 2) of camera `device`; kind PHASE with `points`: the
    same on the projector's plane; else cycles (k, d) along g (d, 2) at camera pixels `place` (k, 2). `sigma` is the
    relative standard deviation, of the residuals' shape.
    """

    kind: str
    device: int
    pose: int
    sighting: int
    place: F64
    sigma: F64
    xy: F64 = field(default_factory=lambda: np.zeros((0, 2)))
    cycles: F64 = field(default_factory=lambda: np.zeros((0, 0)))
    g: F64 = field(default_factory=lambda: np.zeros((0, 2)))
    points: bool = True

    @property
    def key(self) -> tuple[int, str]:
        """Which standard deviation it shares: camera and kind."""
        return self.device, self.kind

    def picked(self, rows: F64 | I32) -> Block:
        """The same with some of its rows."""
        return replace(
            self,
            place=np.ascontiguousarray(self.place[rows]),
            sigma=self.sigma[rows],
            xy=np.ascontiguousarray(self.xy[rows]) if self.points else self.xy,
            cycles=self.cycles if self.points else np.ascontiguousarray(self.cycles[rows]),
        )


@dataclass(frozen=True, eq=False)
class Evaluated:
    """Residuals (n, d) of a block, where they are on the projector plane and on the board, derivatives by `columns`."""

    residual: F64
    uv: F64
    board_xy: F64
    J: F64
    columns: I32


@dataclass(frozen=True, eq=False)
class Problem:
    """Board, devices, measurements; which unknowns are free; priors on unknowns: full index -> (value, sigma)."""

    board: Board
    sizes: Sizes
    poses: tuple[str, ...]
    blocks: tuple[Block, ...]
    free: F64 = field(default_factory=lambda: np.zeros((0, 0)))  #: (full, free) 0/1: a tie has two ones in a column
    priors: Mapping[int, tuple[float, float]] = field(default_factory=dict)

    @property
    def n_full(self) -> int:
        """Length of the full vector."""
        return len(self.sizes.devices) * DEVICE + len(SHAPE) + 6 * len(self.poses)

    @property
    def frame(self) -> F64:
        """Middle x, y of the board and its half diagonal, mm."""
        return board_frame(self.board)

    def device_at(self, device: int) -> int:
        """Where a device's unknowns begin."""
        return device * DEVICE

    @property
    def shape_at(self) -> int:
        """Where the board's shape begins."""
        return len(self.sizes.devices) * DEVICE

    def pose_at(self, pose: int) -> int:
        """Where a pose's unknowns begin."""
        return self.shape_at + len(SHAPE) + 6 * pose


def board_frame(board: Board) -> F64:
    """Middle x, y of the board's squares and half their diagonal, mm."""
    w, h = board.squares[0] * board.square_mm, board.squares[1] * board.square_mm
    return np.array([w / 2 - board.square_mm, h / 2 - board.square_mm, float(np.hypot(w, h)) / 2])


def evaluate(problem: Problem, state: State, b: Block, derivatives: bool = True) -> Evaluated:
    """Residuals of a block and, where asked, their derivatives by the unknowns at `columns`."""
    frame, none = problem.frame, np.zeros((0, 0, 0))
    n = len(b.place)
    R_rb, t_rb = np.ascontiguousarray(state.board_R[b.pose]), np.ascontiguousarray(state.board_t[b.pose])
    shape_at, pose_at = problem.shape_at, problem.pose_at(b.pose)
    tail = [*range(pose_at, pose_at + 6), *range(shape_at, shape_at + len(SHAPE))]
    if b.points:
        device = b.device if b.kind == CORNERS else 0
        residual = np.empty((n, 2))
        J = np.empty((n, 2, 26)) if derivatives and n else none
        kernel.point_rows(
            b.xy, b.place, state.shape, frame, R_rb, t_rb, np.ascontiguousarray(state.R[device]),
            np.ascontiguousarray(state.t[device]), state.lens_ten(device), residual, J,
        )  # fmt: skip
        at = problem.device_at(device)
        uv = residual + b.place if device == 0 else np.full((n, 2), np.nan)
        return Evaluated(residual, uv, b.xy, J, np.array([*range(at, at + DEVICE), *tail], dtype=np.int32))
    residual, uv, board_xy = np.empty((n, len(b.g))), np.empty((n, 2)), np.full((n, 2), np.nan)
    J = np.empty((n, len(b.g), 35)) if derivatives and n else none
    kernel.sample_rows(
        b.place, b.cycles, b.g, state.shape, frame, R_rb, t_rb, np.ascontiguousarray(state.R[b.device]),
        np.ascontiguousarray(state.t[b.device]), state.lens_ten(b.device), state.lens_ten(0), residual, uv,
        board_xy, J,
    )  # fmt: skip
    at = problem.device_at(b.device)
    columns = np.array([*range(9), *range(at, at + DEVICE), *tail], dtype=np.int32)
    return Evaluated(residual, uv, board_xy, J, columns)


Weights = Sequence[F64]  #: per block, of its residuals' shape: 1 / variance, 0 = left out


def cost(problem: Problem, state: State, weights: Weights) -> float:
    """Weighted sum of squares, priors included; infinite where a used measurement cannot be predicted."""
    total = _prior_cost(problem, state)
    for b, w in zip(problem.blocks, weights, strict=True):
        r = evaluate(problem, state, b, derivatives=False).residual
        used = w > 0
        total += float(np.sum(w[used] * r[used] ** 2))
    return total if np.isfinite(total) else np.inf


def value_at(problem: Problem, state: State, index: int) -> float:
    """The value of an unknown of a lens or of the board's shape, by its place in the full vector."""
    if index >= problem.shape_at:
        return float(state.shape[index - problem.shape_at])
    return float(state.lens[index // DEVICE, index % DEVICE])


def _prior_cost(problem: Problem, state: State) -> float:
    return sum(((value_at(problem, state, i) - v) / s) ** 2 for i, (v, s) in problem.priors.items())


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations in the full vector: H, gradient g, cost; per pose where asked."""

    H: F64
    g: F64
    cost: float


def block_normal(problem: Problem, state: State, b: Block, w: F64) -> tuple[I32, F64, F64, float]:
    """One block's share of the normal equations: columns, H, g, cost."""
    e = evaluate(problem, state, b)
    r, J, weight = e.residual.ravel(), e.J.reshape(-1, len(e.columns)), w.ravel()
    used = np.flatnonzero(weight > 0)
    if len(used) < len(r):
        r, J, weight = r[used], J[used], weight[used]
    Jw = J * weight[:, None]
    return e.columns, Jw.T @ J, Jw.T @ r, float(np.sum(weight * r * r))


def normal(problem: Problem, state: State, weights: Weights, priors: bool = True) -> Normal:
    """The normal equations of all blocks and priors."""
    n = problem.n_full
    H, g, total = np.zeros((n, n)), np.zeros(n), 0.0
    for b, w in zip(problem.blocks, weights, strict=True):
        columns, Hb, gb, c = block_normal(problem, state, b, w)
        H[np.ix_(columns, columns)] += Hb
        g[columns] += gb
        total += c
    if priors:
        for i, (v, s) in problem.priors.items():
            H[i, i] += 1 / s**2
            g[i] += (value_at(problem, state, i) - v) / s**2
        total += _prior_cost(problem, state)
    return Normal(H, g, total)


def folded(problem: Problem, N: Normal) -> tuple[F64, F64]:
    """H and g of the free unknowns."""
    S = problem.free
    return S.T @ N.H @ S, S.T @ N.g


def minimise(problem: Problem, state: State, weights: Weights, rounds: int, tolerance: float) -> tuple[State, int]:
    """Levenberg and Marquardt's steps until the cost settles to a share of `tolerance`: state, steps taken.

    Raises CalibrationError if the state that came cannot be measured at all.
    """
    damping, now = 1e-4, cost(problem, state, weights)
    if not np.isfinite(now):
        raise CalibrationError("the start of the solve lies behind a device; photograph the board in other poses")
    taken = 0
    while taken < rounds:
        taken += 1
        H, g = folded(problem, normal(problem, state, weights))
        better = None
        while better is None and damping < 1e8:
            step = damped_step(H, g, damping)
            trial = state.moved(problem.free @ step)
            after = cost(problem, trial, weights)
            if after <= now:
                better = trial
            else:
                damping *= 10
        if better is None:
            break
        gain, now, state = now - after, after, better
        damping = max(damping / 10, 1e-12)
        if gain <= tolerance * max(now, 1e-300):
            break
    return state, taken


def damped_step(H: F64, g: F64, damping: float) -> F64:
    """-(H + damping diag H)^-1 g, scaled to a unit diagonal."""
    d = np.sqrt(np.maximum(np.diag(H), 1e-300))
    A = H / np.outer(d, d)
    A[np.diag_indices_from(A)] += max(damping, 1e-14)
    try:
        return np.asarray(-cho_solve(cho_factor(A), g / d) / d)
    except np.linalg.LinAlgError:
        return np.asarray(-np.linalg.lstsq(A, g / d, rcond=1e-13)[0] / d)


def inverse_normal(H: F64) -> tuple[F64, float]:
    """Inverse of a symmetric positive matrix, scaled to a unit diagonal first, and the scaled one's condition."""
    d = np.sqrt(np.maximum(np.diag(H), 1e-300))
    value, vector = np.linalg.eigh(H / np.outer(d, d))
    value = np.maximum(value, 1e-15 * value[-1])
    return np.asarray((vector / value) @ vector.T / np.outer(d, d)), float(value[-1] / value[0])


def sample_block(s: Sighting, camera: int, pose: int, number: int) -> Block | None:
    """The dense phase samples of a sighting; None where it has none."""
    sigma = s.sample_sigma / (2 * np.pi) / np.linalg.norm(s.directions, axis=1)[None, :] if s.sample_px.size else None
    if sigma is None or not np.isfinite(s.sample_phase).any():
        return None
    return Block(
        PHASE, camera, pose, number, np.array(s.sample_px, dtype=np.float64), np.array(sigma, dtype=np.float64),
        cycles=np.array(s.sample_phase / (2 * np.pi), dtype=np.float64), g=np.array(s.directions, dtype=np.float64),
        points=False,
    )  # fmt: skip


def corner_block(s: Sighting, board: Board, camera: int, pose: int, number: int) -> Block:
    """The corners of a sighting."""
    xy = np.ascontiguousarray(board.corner_mm(s.corner)[:, :2])
    sigma = np.repeat(np.asarray(s.corner_sigma, dtype=np.float64)[:, None], 2, axis=1)
    return Block(CORNERS, camera, pose, number, np.array(s.corner_px, dtype=np.float64), sigma, xy)


def centre_block(s: Sighting, board: Board, camera: int, pose: int, number: int) -> Block | None:
    """The projector's coordinate at the centres of white squares; None where there is none."""
    ok = np.isfinite(s.square_uv).all(axis=1) if len(s.square_uv) else np.zeros(0, dtype=bool)
    if not ok.any():
        return None
    xy = np.ascontiguousarray(board.centre_mm(s.square)[ok, :2])
    place, sigma = np.array(s.square_uv[ok], dtype=np.float64), np.array(s.square_sigma[ok], dtype=np.float64)
    return Block(PHASE, camera, pose, number, place, sigma, xy)
