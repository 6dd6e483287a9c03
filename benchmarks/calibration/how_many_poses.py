"""How many poses of the board does a calibration need? Subsets of one session, each judged by what it did not see.

For every number of poses some subsets are drawn and solved with one lens model. Judged by the poses left out (their
white squares, triangulated, against the board's grid and size), by what the covariance promised, and, where the true
rig is known, by points all over the measuring volume.

Without --session it takes ../shared/data/rendered-small where it lies beside the checkout, else a session of the twin.

    python benchmarks/calibration/how_many_poses.py [--session FOLDER] [--subsets 6] [--quick]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from common import (
    F64,
    Session,
    against_truth,
    arguments,
    look,
    made_up,
    rigid,
    save,
    session_folder,
    table,
    triangulated,
)

from fringescope import calibrate
from fringescope.errors import CalibrationError
from fringescope.settings import CalibrateSettings, Settings
from fringescope.types import Calibration, Rig, Sighting


def subsets(poses: Sequence[str], size: int, most: int, rng: np.random.Generator) -> list[tuple[str, ...]]:
    """At most so many different subsets of a size, drawn at random."""
    every = list(combinations(poses, size))
    return [every[i] for i in sorted(rng.permutation(len(every))[:most])]


def left_out(rig: Rig, d: Session, poses: Sequence[str]) -> tuple[float, float]:
    """White squares' centres of other poses, triangulated: rms distance, um, from the board's grid moved there; and how
    far the board's size is from the true one, rms over poses, ppm.
    """
    squared, count, scales = 0.0, 0, []
    for pose in set(d.poses) - set(poses):
        mine = [n for n in d.sightings if n.pose == pose]
        board = np.concatenate([d.board.centre_mm(n.square) for n in mine])
        found = np.concatenate([triangulated(rig, n.camera, n.square_px, n.square_uv) for n in mine])
        squared += float(np.sum((found - rigid(board, found)) ** 2))
        count += len(board)
        scales.append(extent(found) / extent(board) - 1)
    if not count:
        return float("nan"), float("nan")
    return 1e3 * float(np.sqrt(squared / count)), 1e6 * float(np.sqrt(np.mean(np.square(scales))))


def extent(p: F64) -> float:
    """Root mean square distance from the mean."""
    return float(np.sqrt(np.mean(np.sum((p - p.mean(0)) ** 2, -1))))


def judged(found: Calibration, d: Session, poses: Sequence[str]) -> dict[str, float]:
    """Figures of one subset."""
    sigma = next(p.sigma / p.value for p in found.parameters if (p.device, p.name) == ("projector", "fx"))
    out = {"focal sigma, ppm": 1e6 * float(sigma)}
    out["left out, um"], out["scale, ppm"] = left_out(found.rig, d, poses)
    if d.true is not None:
        out["points, um"], out["between views, um"] = against_truth(found.rig, d.true)
    return out


def solved(sightings: Sequence[Sighting], d: Session, s: CalibrateSettings) -> Calibration | None:
    """A subset's calibration; None, and why, where it cannot be solved."""
    try:
        return calibrate.solve(sightings, d.board, d.sizes, s)
    except CalibrationError as e:
        print(e)
        return None


def main() -> None:
    """Solves subsets of 3 poses and more."""
    ask = arguments(__doc__ or "", "how_many_poses")
    ask.add_argument("--session", type=Path, help="board pictures, or a rig.json that carries its observations")
    ask.add_argument("--subsets", type=int, default=6, help="of each size")
    ask.add_argument("--samples", type=int, default=600, help="phases per picture that are used")
    given = ask.parse_args()
    s = Settings()
    s = replace(s, board=replace(s.board, max_samples=given.samples))
    d = made_up(2, 6, corner_px=0.02, phase_units=0.03) if given.quick else look(session_folder(given.session), s)
    usual = replace(s.calibrate, lens="k1 k2 p1 p2", projector_lens="k1 k2 p1 p2")
    rng = np.random.default_rng(3)
    results: dict[int, dict[str, list[float]]] = {}
    failed: dict[int, int] = {}
    for size in (3, 6) if given.quick else range(3, len(d.poses) + 1):
        figures: dict[str, list[float]] = {}
        for poses in subsets(d.poses, size, 2 if given.quick else given.subsets, rng):
            found = solved([n for n in d.sightings if n.pose in poses], d, usual)
            if found is None:
                failed[size] = failed.get(size, 0) + 1
                continue
            for key, value in judged(found, d, poses).items():
                figures.setdefault(key, []).append(value)
        if figures:
            results[size] = figures
    keys = list(next(iter(results.values())))
    rows = [[n, f"{len(f[keys[0]])} ({failed.get(n, 0)})", *(typical(f[k]) for k in keys)] for n, f in results.items()]
    table(["poses", "subsets (failed)", *(f"{k} (worst)" for k in keys)], rows, 27)
    told = {str(n): f for n, f in results.items()}
    save(given.out, {"poses": told, "failed": failed}, lambda figure: draw(figure, results, keys), (11, 3.4))


def typical(values: Sequence[float]) -> str:
    """Median and worst."""
    return f"{np.median(values):.3g} ({np.max(values):.3g})"


def draw(figure: Any, results: dict[int, dict[str, list[float]]], keys: list[str]) -> None:
    """One panel per figure: every subset, and the median."""
    axes = figure.subplots(1, len(keys), squeeze=False)[0]
    for a, key in zip(axes, keys, strict=True):
        for n, f in results.items():
            a.semilogy([n] * len(f[key]), f[key], ".", color="tab:gray")
        a.semilogy(list(results), [np.median(f[key]) for f in results.values()], "o-", color="tab:blue")
        a.set_title(key, fontsize=9)
        a.set_xlabel("poses")
        a.grid(alpha=0.3, which="both")


if __name__ == "__main__":
    main()
