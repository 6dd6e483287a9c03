"""Which feature of a board tells the projector's coordinate best? White squares, corners and circles compared.

The paper (III-B, Fig. 4, V-A) reads the phase at the diagonal centres of white squares: at a corner the phase is spoilt
by blur, and the centre of a circle's picture is not the picture of its centre. Here a camera looks at a board of white
squares, and at one with white discs in their places, drawn exactly: perspective, lens distortion, blur, noise. What
each feature says is compared with where the projector's image of it truly lies. Bias: rms over all features of the
board without noise; noise: standard deviation that noise adds. Both in projector-plane units (54 um on the board).

    python benchmarks/calibration/features.py [--quick] [--out build/studies/features.json]
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from common import F64, arguments, save, table

from fringescope import calibrate, geometry
from fringescope.errors import CalibrationError
from fringescope.types import (
    Board,
    Camera,
    Decoded,
    Direction,
    FringeSet,
    Layout,
    Lens,
    NoiseModel,
    PixelFormat,
    Pose,
    Projector,
    ViewPlan,
)

BOARD = Board((10, 7), 5.0)
PERIOD = 36.0  #: of the fringes, projector-plane units
STEPS = 8
FINE = 3  #: samples per pixel, each way
DARK = 0.06  #: reflectance of black over that of white


@dataclass(frozen=True)
class View:
    """How the board is seen. `bend_px`: how far distortion moves the corners of the picture, pixels."""

    tilt_deg: float = 30.0
    bend_px: float = 3.0
    blur_px: float = 0.8
    noise: float = 1.2  #: codes, where white has an amplitude of 60
    width: int = 480
    height: int = 380
    focal: float = 3700.0
    distance: float = 500.0


class Bench:
    """A camera, a projector beside it, and a board between them."""

    def __init__(self, v: View) -> None:
        half = np.hypot(v.width, v.height) / 2
        k1 = -v.bend_px / half / (half / v.focal) ** 2
        K = np.array([[v.focal, 0, v.width / 2 - 3.3], [0, v.focal, v.height / 2 + 2.1], [0, 0, 1.0]])
        self.view = v
        lens = Lens(v.width, v.height, K, np.array([k1, 0, 0, 0, 0]))
        self.camera = Camera("camera1", lens, looking((0, 0, -v.distance)))
        P = np.array([[9120.0, 0, 911], [0, 9120.0, 569], [0, 0, 1]])
        inverse = Lens(1824, 1140, P, np.array([-0.05, 0.1, 0, 0, 0]))
        self.projector = Projector(912, 1140, Layout.DIAMOND, inverse, looking((-180.0, 0, -460)))
        tilt, roll = np.radians(v.tilt_deg), 0.13
        R = cv2.Rodrigues(tilt * np.array([0.94, 0.34, 0]))[0] @ cv2.Rodrigues(np.array([0, 0, roll]))[0]
        self.pose = Pose(R, -R @ np.array([*(np.array(BOARD.inner_corners) - 1) / 2 * BOARD.square_mm, 0]))

    def board_of(self, px: F64) -> tuple[F64, F64]:
        """World points (n, 3) and board coordinates in squares (n, 2) at pixels (n, 2)."""
        origin, ray = geometry.world_rays(self.camera, px)
        n = self.pose.R[:, 2]
        world = origin + ray * (((self.pose.t - origin) @ n) / (ray @ n))[:, None]
        return world, ((world - self.pose.t) @ self.pose.R)[:, :2] / BOARD.square_mm

    def seen(self, board_mm: F64) -> F64:
        """Pixels (n, 2) of board points (n, 3)."""
        return geometry.project(self.camera, geometry.transform(self.pose, board_mm))

    def truth(self, board_mm: F64) -> F64:
        """The projector's coordinates (n, 2) of board points (n, 3)."""
        return geometry.project(self.projector, geometry.transform(self.pose, board_mm))

    def picture(self, reflectance: Callable[[F64, F64], F64]) -> F64:
        """White share, and that times cos and sin of both phases (5, H, W), through blur and the pixels' squares."""
        v = self.view
        x = (np.arange(v.width * FINE) + 0.5) / FINE - 0.5
        y = (np.arange(v.height * FINE) + 0.5) / FINE - 0.5
        px = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
        world, flat = self.board_of(px)
        shape = (v.height * FINE, v.width * FINE)
        foot = np.sqrt(np.abs(np.linalg.det(np.stack(np.gradient(flat.reshape(*shape, 2), axis=(0, 1)), -1))))
        r = (DARK + (1 - DARK) * reflectance(flat, foot.ravel())).reshape(shape)
        phi = (2 * np.pi / PERIOD * geometry.project(self.projector, world)).reshape(*shape, 2)
        planes = [r, r * np.cos(phi[..., 0]), r * np.sin(phi[..., 0]), r * np.cos(phi[..., 1]), r * np.sin(phi[..., 1])]
        blurred = [cv2.GaussianBlur(p.astype(np.float32), (0, 0), v.blur_px * FINE) for p in planes]
        return np.stack([b.reshape(v.height, FINE, v.width, FINE).mean((1, 3)) for b in blurred]).astype(np.float64)

    def decoded(self, planes: F64, rng: np.random.Generator | None) -> Seen:
        """What the phase-shifting frames of a picture give; with noise if there are random numbers."""
        amplitude = 60.0
        level = self.view.noise * np.sqrt(2 / STEPS) / amplitude
        noisy = planes.copy()
        if rng is not None:
            noisy[1:] += level * rng.standard_normal(noisy[1:].shape)
            noisy[0] += level / 2 * rng.standard_normal(noisy[0].shape)
        modulation = np.hypot(noisy[1], noisy[2])
        sigma = level / np.maximum(modulation, 1e-3)
        x, y = np.meshgrid(np.arange(self.view.width), np.arange(self.view.height))
        world, _ = self.board_of(np.stack([x, y], -1).reshape(-1, 2).astype(float))
        ideal = geometry.project(self.projector, world).reshape(*x.shape, 2)
        phases = []
        for d in range(2):  # the order of a fringe is no question here: the nearest to the truth
            wrapped = np.arctan2(noisy[2 + 2 * d], noisy[1 + 2 * d])
            phases.append(wrapped + 2 * np.pi * np.rint(ideal[..., d] / PERIOD - wrapped / (2 * np.pi)))
        return Seen(noisy[0], np.stack(phases, -1), sigma, amplitude * modulation)


@dataclass(frozen=True, eq=False)
class Seen:
    """White share (H, W), absolute phases (H, W, 2), their standard deviation and the modulation in codes (H, W)."""

    white: F64
    phase: F64
    sigma: F64
    modulation: F64

    @property
    def uv(self) -> F64:
        """Projector coordinates (H, W, 2)."""
        return np.asarray(self.phase * PERIOD / (2 * np.pi))


def looking(at: tuple[float, float, float]) -> Pose:
    """A device at a place that looks at the origin."""
    c = np.array(at)
    z = -c / np.linalg.norm(c)
    x = np.cross([0.0, 1, 0], z)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return Pose(R, -R @ c)


# -------------------------------------------------------------------------------------------------------------- boards


def squares(flat: F64, foot: F64) -> F64:
    """A chequerboard, the square at (-1, -1) to (0, 0) black, edges drawn over the width of a sample."""
    columns, rows = BOARD.squares
    inside = np.ones(len(flat))
    for c, n in zip(flat.T, (columns, rows), strict=True):
        inside *= np.clip(np.minimum(c + 1, n - 1 - c) / foot + 0.5, 0, 1)
    return np.asarray(1 - inside * (1 + edges(flat[:, 0], foot) * edges(flat[:, 1], foot)) / 2)


def edges(c: F64, foot: F64) -> F64:
    """+1 and -1 in turn from line to line, passing through 0 at each over the width of a sample."""
    d = (c + 0.5) % 1 - 0.5  # signed distance to the nearest line
    sign = 1 - 2 * (np.rint(c) % 2)
    return np.asarray(sign * np.clip(2 * d / foot, -1, 1))


def discs(flat: F64, foot: F64) -> F64:
    """White discs on black, as wide as a square, where the chequerboard's white squares have their centres."""
    cell = np.floor(flat).astype(int)
    white = (cell.sum(1) % 2) == 1
    d = np.linalg.norm(flat - (cell + 0.5), axis=1)
    return np.asarray(white * np.clip((0.5 - d) / foot + 0.5, 0, 1))


def white_squares() -> np.ndarray[Any, np.dtype[np.int32]]:
    """Those with four inner corners."""
    columns, rows = BOARD.inner_corners
    return np.array([(c, r) for r in range(1, rows) for c in range(1, columns) if (c + r) % 2], np.int32)


# ------------------------------------------------------------------------------------------------------------ features
# each: what was seen of both boards -> projector coordinates and the truth, (n, 2) each

Features = dict[str, tuple[F64, F64]]


def smooth(px: F64, uv: F64, at: F64) -> F64:
    """Value at a place of a second-order fit of uv (n, 2) over pixels (n, 2)."""
    x, y = ((px - at) / max(float(np.abs(px - at).max()), 1e-9)).T
    A = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    return np.asarray(np.linalg.lstsq(A, uv, rcond=None)[0][0])


def at_corners(b: Bench, s: Seen, corner: Any, px: F64) -> Features:
    truth = b.truth(BOARD.corner_mm(corner))
    at = px.astype(np.float32)[None]
    planes = [np.ascontiguousarray(s.uv[..., d]) for d in range(2)]
    pixel = np.stack([cv2.remap(p, at, None, cv2.INTER_LINEAR)[0] for p in planes], -1)
    bright = s.modulation > 0.3 * 60
    mapped = np.full(truth.shape, np.nan)
    half = 23  # pixels: the window of 47 x 47 that Moreno and Taubin recommend
    for i, c in enumerate(px):
        x, y = np.rint(c).astype(int)
        rows, columns = np.nonzero(bright[max(y - half, 0) : y + half + 1, max(x - half, 0) : x + half + 1])
        there = np.column_stack([columns + max(x - half, 0), rows + max(y - half, 0)]).astype(float)
        H, _ = cv2.findHomography(there - c, s.uv[there[:, 1].astype(int), there[:, 0].astype(int)], cv2.RANSAC, 1.0)
        mapped[i] = H[:2, 2] / H[2, 2]
    return {"corner, phase of its pixels": (pixel, truth), "corner, local homography": (mapped, truth)}


def at_squares(b: Bench, s: Seen, corner: Any, px: F64) -> Features:
    place = {tuple(k): p for k, p in zip(corner.tolist(), px, strict=True)}
    found, truth = [], []
    for c, r in white_squares().tolist():
        quad = np.array([place.get(k, (np.nan, np.nan)) for k in ((c - 1, r - 1), (c, r - 1), (c, r), (c - 1, r))])
        if not np.isfinite(quad).all():
            continue
        a, d = quad[2] - quad[0], quad[3] - quad[1]
        centre = quad[0] + np.linalg.solve(np.column_stack([a, -d]), quad[1] - quad[0])[0] * a
        shrunk = quad.mean(0) + 0.6 * (quad - quad.mean(0))
        inside = cv2.fillConvexPoly(np.zeros(s.white.shape, np.uint8), np.rint(shrunk).astype(np.int32), 1)
        y, x = np.nonzero(inside)
        found.append(smooth(np.column_stack([x, y]).astype(float), s.uv[y, x], centre))
        truth.append(b.truth(BOARD.centre_mm(np.array([[c, r]])))[0])
    return {"white square, diagonals of its corners": (np.array(found), np.array(truth))}


def at_discs(b: Bench, s: Seen) -> Features:
    """The centre of the ellipse through each disc's outline, where its light falls to one half."""
    share = ((s.white - DARK) / (1 - DARK)).astype(np.float32)
    index = white_squares()
    truth = b.truth(BOARD.centre_mm(index))
    turn, reach = np.linspace(0, 2 * np.pi, 60, endpoint=False), np.linspace(0.7, 1.35, 40)
    rays = np.stack([np.outer(reach, np.cos(turn)), np.outer(reach, np.sin(turn)), np.zeros((40, 60))], -1)
    found = []
    for middle in BOARD.centre_mm(index):
        px = b.seen((middle + BOARD.square_mm / 2 * rays).reshape(-1, 3)).reshape(40, 60, 2)
        light = cv2.remap(share, px.astype(np.float32), None, cv2.INTER_LINEAR)
        k = np.argmax(light < 0.5, axis=0)
        each = np.arange(60)
        part = (light[k - 1, each] - 0.5) / (light[k - 1, each] - light[k, each])
        outline = px[k - 1, each] + part[:, None] * (px[k, each] - px[k - 1, each])
        centre = ellipse_centre(outline)
        shrunk = centre + 0.6 * (outline - centre)
        inside = cv2.fillConvexPoly(np.zeros(share.shape, np.uint8), np.rint(shrunk).astype(np.int32), 1)
        y, x = np.nonzero(inside)
        found.append(smooth(np.column_stack([x, y]).astype(float), s.uv[y, x], centre))
    return {"disc, centre of its picture": (np.array(found), truth)}


def ellipse_centre(outline: F64) -> F64:
    """Of the conic a x^2 + b xy + c y^2 + d x + e y = 1 through points (n, 2), by least squares."""
    middle = outline.mean(0)
    size = float(np.ptp(outline, axis=0).max())
    x, y = ((outline - middle) / size).T
    a, b, c, d, e = np.linalg.lstsq(np.column_stack([x * x, x * y, y * y, x, y]), np.ones(len(x)), rcond=None)[0]
    return np.asarray(middle - size * np.linalg.solve([[2 * a, b], [b, 2 * c]], [d, e]))


def ours(b: Bench, s: Seen) -> tuple[Any, F64, Features]:
    """What the package sees: corners (index, place), white squares, and its samples against the board's plane."""
    phases = tuple(
        Direction(g, s.phase[..., d].astype(np.float32), s.sigma.astype(np.float32), s.sigma.astype(np.float32) * 0 + 9)
        for d, g in enumerate(((1 / PERIOD, 0.0), (0.0, 1 / PERIOD)))
    )
    image = (80 * s.white).astype(np.float32)
    nothing = np.zeros(image.shape, np.uint16)
    decoded = Decoded("camera1", phases, (), (), image, s.modulation.astype(np.float32), nothing, NoiseModel(1.0, 0.0))
    plan = ViewPlan("camera1", PixelFormat.MONO8, tuple(FringeSet(d.g, STEPS) for d in phases), (1824, 1140))
    n = calibrate.see(decoded, image, plan, BOARD, "pose00")
    g = 2 * np.pi / PERIOD
    world, _ = b.board_of(n.sample_px)
    found = {
        "white square, ours": (n.square_uv, b.truth(BOARD.centre_mm(n.square))),
        "single pixels of white squares, ours": (n.sample_phase / g, geometry.project(b.projector, world)),
    }
    return n.corner, n.corner_px, found


def features(b: Bench, boards: tuple[F64, F64], rng: np.random.Generator | None) -> Features:
    """All features of both boards."""
    chequered, dotted = (b.decoded(p, rng) for p in boards)
    corner, px, found = ours(b, chequered)
    return at_corners(b, chequered, corner, px) | at_discs(b, dotted) | at_squares(b, chequered, corner, px) | found


def measure(v: View, repeats: int, seed: int = 1) -> dict[str, dict[str, float]]:
    """Bias and noise of every feature, projector-plane units."""
    b = Bench(v)
    boards = b.picture(squares), b.picture(discs)
    rng = np.random.default_rng(seed)
    clean = features(b, boards, None)
    noisy = [features(b, boards, rng) for _ in range(repeats)]
    out = {}
    for name, (found, truth) in clean.items():
        bias = found - truth
        spread = [n[name][0] - n[name][1] - bias for n in noisy if n[name][0].shape == bias.shape]
        if name.startswith("single"):  # other pixels each time
            spread = [n[name][0] - n[name][1] for n in noisy]
        out[name] = {
            "bias": float(np.sqrt(np.nanmean(np.sum(bias**2, -1)))),
            "noise": float(np.sqrt(np.nanmean(np.sum(np.concatenate(spread) ** 2, -1)))) if spread else float("nan"),
        }
    return out


#: what is changed: its name for people, and its values
SWEEPS: dict[str, tuple[str, tuple[float, ...]]] = {
    "tilt_deg": ("tilt of the board, degrees", (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0)),
    "bend_px": ("distortion at the picture's corners, pixels", (0.0, 3.0, 10.0, 30.0)),
    "blur_px": ("blur, pixels", (0.5, 0.8, 1.5, 2.5)),
}


def sweep(usual: View, name: str, quick: bool) -> dict[str, Any]:
    """Bias and noise of every feature while one thing changes; what cannot be seen is left out."""
    label, values = SWEEPS[name]
    done: dict[float, dict[str, dict[str, float]]] = {}
    for x in (0.0, 40.0) if quick else values:
        try:
            done[x] = measure(replace(usual, **{name: x}), 1 if quick else 4)
        except CalibrationError as e:
            print(f"{label} {x}: {e}")
    names = list(next(iter(done.values()))) if done else []
    told = {n: {k: [d[n][k] for d in done.values()] for k in ("bias", "noise")} for n in names}
    return {"label": label, "at": list(done), "features": told}


def main() -> None:
    """Sweeps tilt, distortion and blur."""
    given = arguments(__doc__ or "", "features").parse_args()
    usual = View(width=400, height=300, focal=3000.0) if given.quick else View()
    results = {name: sweep(usual, name, given.quick) for name in (("tilt_deg",) if given.quick else SWEEPS)}
    for r in results.values():
        for kind in ("bias", "noise"):
            print(f"\n{kind}, projector-plane units, against {r['label']}")
            table(["", *map(str, r["at"])], [[n, *f[kind]] for n, f in r["features"].items()], 10)
    save(given.out, {"units": "projector plane", "sweeps": results}, lambda figure: draw(figure, results), (11, 7))


def draw(figure: Any, results: dict[str, dict[str, Any]]) -> None:
    """Bias above, noise below, one column per sweep."""
    shown = [r for r in results.values() if r["at"]]
    axes = figure.subplots(2, len(shown), squeeze=False, sharey="row")
    for column, r in enumerate(shown):
        for row, kind in enumerate(("bias", "noise")):
            a = axes[row][column]
            for name, f in r["features"].items():
                if not (kind == "bias" and name.startswith("single")):
                    a.semilogy(r["at"], f[kind], "o-", label=name, markersize=4)
            a.grid(alpha=0.3, which="both")
            a.set_xlabel(r["label"])
        axes[0][0].set_ylabel("bias, projector-plane units")
        axes[1][0].set_ylabel("noise, projector-plane units")
    handles, labels = axes[1][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=8, frameon=False)


if __name__ == "__main__":
    main()
