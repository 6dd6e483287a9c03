"""What the studies of calibration share: sessions to calibrate from, rigs to judge, tables, pictures and JSON."""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from fringescope import __version__, calibrate, geometry, pipeline, store
from fringescope.settings import Settings
from fringescope.twin import presets
from fringescope.types import Board, Camera, Pose, Rig, Sighting

F64 = NDArray[np.float64]
ROOT = Path(__file__).resolve().parents[2]
RENDERED = ROOT.parent / "shared" / "data" / "rendered-small"  #: a path-traced session, where the checkout has one


def arguments(text: str, name: str) -> argparse.ArgumentParser:
    """What every study can be asked."""
    ask = argparse.ArgumentParser(description=text.splitlines()[0])
    usual = ROOT / "build" / "studies" / f"{name}.json"
    ask.add_argument("--out", type=Path, default=usual, help="JSON; beside it a PNG")
    ask.add_argument("--quick", action="store_true", help="small and made up: shows that it works, proves little")
    return ask


def save(out: Path, figures: dict[str, Any], draw: Callable[[Any], None], size: tuple[float, float]) -> None:
    """Writes the figures and a picture of them."""
    out.parent.mkdir(parents=True, exist_ok=True)
    now = datetime.now(UTC).isoformat(timespec="seconds")
    head = {"date": now, "version": __version__, "machine": platform.machine()}
    out.write_text(json.dumps(head | figures, indent=1) + "\n")
    picture = plt.figure(figsize=size, dpi=110, layout="constrained")
    draw(picture)
    picture.savefig(out.with_suffix(".png"))
    plt.close(picture)
    print(f"{out}, {out.with_suffix('.png').name}")


def table(head: Sequence[str], rows: Sequence[Sequence[Any]], width: int = 12) -> None:
    """Prints a table; the first column is words."""
    first = max(len(str(r[0])) for r in [head, *rows]) + 1
    for row in [head, *rows]:
        cells = [f"{c:.4g}" if isinstance(c, float) else str(c) for c in row[1:]]
        print(f"{row[0]:{first}}" + "".join(f"{c:>{width}}" for c in cells))


# ------------------------------------------------------------------------------------------------------------ sessions


@dataclass(frozen=True, eq=False)
class Session:
    """Sightings of a board, and the true rig where it is known."""

    sightings: tuple[Sighting, ...]
    board: Board
    sizes: calibrate.Sizes
    true: Rig | None

    @property
    def poses(self) -> list[str]:
        return sorted({n.pose for n in self.sightings})


def look(folder: Path, s: Settings) -> Session:
    """A session's pictures, or the observations that a calibrated rig carries."""
    places = (folder / "truth" / "rig.json", folder.parent / "truth" / "rig.json")
    truth = next((p for p in places if p.is_file()), None)
    true = store.read_rig(truth) if truth else None
    if folder.is_file():
        board, seen = store.read_observations(folder)
        p, cameras = store.read_rig(folder).projector, store.read_rig(folder).cameras
        sizes = calibrate.Sizes((p.width, p.height), p.layout, {c.name: (c.lens.width, c.lens.height) for c in cameras})
        return Session(seen, board, sizes, true)
    session = store.read_session(folder)
    out: list[Sighting] = []
    for pose, shot in session.poses:
        print(f"looking at {pose}", file=sys.stderr)
        found = [pipeline.see_board(v, session.board, pose, s)[0] for v in store.view_inputs(shot)]
        out += calibrate.agree([n for n in found if n is not None], session.board)
    first = session.poses[0][1]
    sizes = calibrate.Sizes((first.projector_width, first.projector_height), first.layout, dict(session.sizes))
    return Session(tuple(out), session.board, sizes, true)


def session_folder(asked: Path | None) -> Path:
    """The session that is asked for; else the rendered one beside the checkout; else one of the twin, made once."""
    if asked is not None:
        return asked
    if RENDERED.is_dir():
        return RENDERED / "calibration"
    made = ROOT / "build" / "studies" / "session"
    if not (made / "board.json").is_file():
        simulate("board", made, "--poses", "9")
    return made


def simulate(scene: str, out: Path, *more: str) -> None:
    """A capture or session of the twin at a sixteenth of the paper's sampling."""
    verb = [sys.executable, "-m", "fringescope", "simulate", scene, "--scale", "0.0625", "--seed", "5"]
    subprocess.run([*verb, "--out", str(out), *more], check=True)


def made_up(seed: int, poses: int, corner_px: float, phase_units: float) -> Session:
    """What the cameras of the paper's rig would see of a board, with noise on corners and phases; no pictures."""
    rig = presets.instrument("paper", 0.125).rig
    board = Board((12, 9), 5.0)
    rng = np.random.default_rng(seed)
    columns, rows = board.inner_corners
    corner = np.array([(i, j) for j in range(rows) for i in range(columns)], np.int32)
    square = np.array([(i, j) for j in range(1, rows) for i in range(1, columns) if (i + j) % 2], np.int32)
    directions = np.array([[1 / 36, 0.0], [0.0, 1 / 36]])
    p = rig.projector
    out = []
    for n in range(poses):
        T = board_pose(rng, n, board)
        for c in rig.cameras:
            spot = np.repeat(board.centre_mm(square), 8, axis=0)
            spot[:, :2] += rng.uniform(-0.3, 0.3, (len(spot), 2)) * board.square_mm
            at = np.round(geometry.project(c, geometry.transform(T, spot)))
            units = geometry.project(p, on_board(c, at, T)) + phase_units * rng.standard_normal((len(at), 2))
            middle = geometry.transform(T, board.centre_mm(square))
            px = geometry.project(c, geometry.transform(T, board.corner_mm(corner)))
            spx = geometry.project(c, middle) + corner_px / 2 * rng.standard_normal((len(square), 2))
            uv = geometry.project(p, middle) + phase_units / 6 * rng.standard_normal((len(square), 2))
            size = (c.lens.width, c.lens.height)
            out.append(
                Sighting(
                    f"pose{n:02d}", c.name, size, corner, px + corner_px * rng.standard_normal(px.shape),
                    np.full(len(px), corner_px), square, spx, uv, np.full(uv.shape, phase_units / 6),
                    directions, at, 2 * np.pi * units @ directions.T,
                    np.full((len(at), 2), 2 * np.pi * phase_units / 36),
                )
            )  # fmt: skip
    sizes = calibrate.Sizes((p.width, p.height), p.layout, {c.name: (c.lens.width, c.lens.height) for c in rig.cameras})
    return Session(tuple(out), board, sizes, rig)


def board_pose(rng: np.random.Generator, number: int, board: Board) -> Pose:
    """T_world_board about the working point, tilted by 10 to 25 degrees to another side each time."""
    tilt = 0.03 if number == 0 else rng.uniform(0.17, 0.44)
    towards, turn = 2.4 * number + rng.uniform(-0.4, 0.4), rng.uniform(-0.3, 0.3)
    axis = np.array([np.cos(towards), np.sin(towards), 0.0])
    K = np.cross(np.eye(3), axis)
    lean = np.eye(3) - np.sin(tilt) * K + (1 - np.cos(tilt)) * K @ K
    spin = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    R = lean @ spin @ np.diag([1.0, -1, -1])
    middle = np.array([*(np.array(board.inner_corners) - 1) / 2 * board.square_mm, 0])
    return Pose(R, np.array([*rng.uniform(-6, 6, 2), rng.uniform(-10, 10)]) - R @ middle)


def on_board(camera: Camera, px: F64, T: Pose) -> F64:
    """Where the rays of pixels (n, 2) meet the board, world mm (n, 3)."""
    origin, ray = geometry.world_rays(camera, px)
    normal = T.R[:, 2]
    return np.asarray(origin + ray * (((T.t - origin) @ normal) / (ray @ normal))[:, None])


# ------------------------------------------------------------------------------------------------------------- judging


def triangulated(rig: Rig, camera: str, px: F64, uv: F64) -> F64:
    """World points (n, 3), mm, midway between the rays of camera pixels and of projector coordinates."""
    a0, a = geometry.world_rays(rig.camera(camera), px)
    b0, b = geometry.world_rays(rig.projector, uv)
    w, ab = b0 - a0, (a * b).sum(-1)
    aw, bw = a @ w, b @ w
    s, t = (aw - ab * bw) / (1 - ab**2), (ab * aw - bw) / (1 - ab**2)
    return np.asarray((a0 + s[:, None] * a + b0 + t[:, None] * b) / 2)


def against_truth(rig: Rig, true: Rig, half_mm: tuple[float, float, float] = (25.0, 18.0, 8.0)) -> tuple[float, float]:
    """Errors, um, of points that `rig` triangulates from what the true one images: after one rigid movement of all of
    them (rms), and between the cameras, each point against the mean of its views (rms).
    """
    grid = np.stack(np.meshgrid(*[np.linspace(-h, h, 5) for h in half_mm]), -1).reshape(-1, 3)
    grid = grid + geometry.working_point(true)
    uv = geometry.project(true.projector, grid)
    found = np.stack([triangulated(rig, c.name, geometry.project(c, grid), uv) for c in true.cameras])
    moved = rigid(grid, found.mean(0))
    error = found - moved
    views = found - found.mean(0)
    return 1e3 * float(np.sqrt(np.mean(np.sum(error**2, -1)))), 1e3 * float(np.sqrt(np.mean(np.sum(views**2, -1))))


def rigid(a: F64, b: F64) -> F64:
    """Points a (n, 3) moved onto b by the best rotation and shift."""
    p, q = a - a.mean(0), b - b.mean(0)
    U, _, Vt = np.linalg.svd(p.T @ q)
    R = Vt.T @ np.diag([1, 1, np.linalg.det(Vt.T @ U.T)]) @ U.T
    return np.asarray(p @ R.T + b.mean(0))
