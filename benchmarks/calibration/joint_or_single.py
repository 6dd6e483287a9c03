"""One joint adjustment, or each device on its own? The same pictures, several ways to a rig, judged from outside.

Device by device: OpenCV's calibrateCamera for every camera and, with the projector's coordinates in place of corners,
for the projector; then stereoCalibrate for each camera and the projector (Zhang 2000, doi:10.1109/34.888718; Moreno and
Taubin 2012, doi:10.1109/3DIMPVT.2012.77). Jointly: `calibrate.solve`, the projector tied by the phase at fixed camera
pixels (samples), at the centres of white squares, or at corners. All get the same measurements. The corners' residuals
cannot tell the ways apart; what counts is whether the cameras' surfaces agree, and whether a plane is flat and a sphere
round.

Without --session it takes ../shared/data/rendered-small where it lies beside the checkout, else a session of the twin.

    python benchmarks/calibration/joint_or_single.py [--session FOLDER --plane CAPTURE --sphere CAPTURE] [--quick]
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from common import (
    F64,
    RENDERED,
    ROOT,
    Session,
    against_truth,
    arguments,
    look,
    made_up,
    save,
    session_folder,
    simulate,
    table,
)

from fringescope import calibrate, evaluate, pipeline, store
from fringescope.settings import Settings
from fringescope.types import Calibration, Camera, Layout, Lens, Pose, Projector, Rig, Sighting

# ---------------------------------------------------------------------------------------------------- device by device


def at_corners(n: Sighting) -> F64:
    """The projector's coordinate at each corner: a homography of the phases around it; NaN = too few."""
    px = n.sample_px
    uv = np.linalg.lstsq(2 * np.pi * n.directions, n.sample_phase.T, rcond=None)[0].T
    ok = np.isfinite(uv).all(1)
    px, uv = px[ok], uv[ok]
    span, steps = np.ptp(n.corner_px, axis=0), np.ptp(n.corner, axis=0)
    reach = 1.6 * float(np.linalg.norm(span) / np.linalg.norm(steps))
    out = np.full(n.corner_px.shape, np.nan)
    for i, c in enumerate(n.corner_px):
        near = np.abs(px - c).max(1) < reach
        if near.sum() >= 16:
            H, _ = cv2.findHomography(px[near] - c, uv[near])
            out[i] = H[:2, 2] / H[2, 2]
    return out


def device_by_device(d: Session, at: str) -> tuple[Rig, float]:
    """A rig by OpenCV, the projector's coordinates read at "corners" or "centres"; and the rms of its corners, px."""
    own = [(n, at_corners(n)) for n in d.sightings] if at == "corners" else []
    seen_by_projector = []
    for i, n in enumerate(d.sightings):
        if at == "corners":
            ok = np.isfinite(own[i][1]).all(1)
            seen_by_projector.append((n, d.board.corner_mm(n.corner)[ok], n.corner_px[ok], own[i][1][ok]))
        else:
            seen_by_projector.append((n, d.board.centre_mm(n.square), n.square_px, n.square_uv))
    single = [(p.astype(np.float32), uv.astype(np.float32)) for _, p, _, uv in seen_by_projector]
    W = d.sizes.projector[0] * (2 if d.sizes.layout is Layout.DIAMOND else 1)
    size = (W, d.sizes.projector[1])
    P, dist_p, _ = one_device(single, size)
    cameras, misses = [], []
    for name, pixels in d.sizes.cameras.items():
        mine = [(d.board.corner_mm(n.corner), n.corner_px) for n in d.sightings if n.camera == name]
        K, dist, rms = one_device([(p.astype(np.float32), q.astype(np.float32)) for p, q in mine], pixels)
        both = [(p, px, uv) for n, p, px, uv in seen_by_projector if n.camera == name]
        p, px, uv = ([x.astype(np.float32) for x in column] for column in zip(*both, strict=True))
        *_, R, t, _, _ = cv2.stereoCalibrate(p, uv, px, P, dist_p, K, dist, size, flags=cv2.CALIB_FIX_INTRINSIC)
        cameras.append(Camera(name, Lens(*pixels, K, dist.ravel()[:5]), Pose(R, t.ravel())))
        misses.append(rms)
    lens = Lens(*size, P, dist_p.ravel()[:5])
    projector = Projector(*d.sizes.projector, d.sizes.layout, lens, Pose(np.eye(3), np.zeros(3)))
    return Rig(projector, tuple(cameras)), float(np.sqrt(np.mean(np.square(misses))))


def one_device(views: list[tuple[Any, Any]], size: tuple[int, int]) -> tuple[F64, F64, float]:
    """K, distortion and rms, px, of one device from board points and their images."""
    points, images = ([v[k] for v in views if len(v[0]) >= 6] for k in range(2))
    K0 = np.array([[3.0 * max(size), 0, size[0] / 2], [0, 3.0 * max(size), size[1] / 2], [0, 0, 1]])
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS
    starts: list[Callable[[], Any]] = [
        lambda: cv2.calibrateCamera(points, images, size, None, None, flags=cv2.CALIB_FIX_K3),
        lambda: cv2.calibrateCamera(points, images, size, K0.copy(), np.zeros(5), flags=flags),
    ]
    rms, K, distortion, *_ = min((start() for start in starts), key=lambda found: float(found[0]))
    return np.asarray(K, dtype=np.float64), np.asarray(distortion, dtype=np.float64), float(rms)


# ------------------------------------------------------------------------------------------------------------- judging


def rms_of(c: Calibration) -> float:
    """Of the lengths of the corners' residuals, px."""
    every = np.concatenate([np.sum(r.corner**2, -1) for r in c.residuals])
    return float(np.sqrt(np.nanmean(every)))


def rigs(d: Session, s: Settings) -> dict[str, tuple[Rig, float]]:
    """The same session solved in every way: rig and rms of the corners, px."""
    out: dict[str, tuple[Rig, float]] = {}
    for at in ("corners", "centres"):
        out[f"OpenCV device by device, phase at {at}"] = device_by_device(d, at)
    for how in ("corners", "centres", "samples"):
        found = calibrate.solve(d.sightings, d.board, d.sizes, replace(s.calibrate, projector=how))
        out[f"joint, {how}"] = found.rig, rms_of(found)
    if d.true is not None:
        out["the true rig"] = d.true, float("nan")
    return out


def in_captures(rig: Rig, plane: Path | None, sphere: Path | None, s: Settings) -> dict[str, float]:
    """What a rig makes of captures: how far the views' surfaces are apart, form of a plane, errors of radii, um."""
    out: dict[str, float] = {}
    for what, capture in (("plane", plane), ("sphere", sphere)):
        if capture is None:
            continue
        scan = pipeline.scan(store.view_inputs(store.read_capture(capture)), rig, s, all_points=True, surface=False)
        assert scan.all_points is not None
        apart = evaluate.agreement(scan.grids, rig)
        out[f"{what}: views apart"] = float(apart.median_um or np.nan)
        out[f"{what}: systematic"] = float(apart.systematic_um or np.nan)
        if what == "plane":
            fit = evaluate.fit_plane(scan.all_points.xyz)
            out |= {"plane: std": fit.spread.std_um, "plane: form": float(fit.form_um or np.nan)}
        else:
            for sphere_fit in evaluate.fit_spheres(scan.all_points.xyz, radii(capture)):
                name = f"radius of {sphere_fit.nominal_radius_mm or sphere_fit.radius_mm:.4g} mm: error"
                out[name] = float(sphere_fit.radius_error_um if sphere_fit.radius_error_um is not None else np.nan)
    return out


def radii(capture: Path) -> tuple[float, ...]:
    """The true radii, mm, of a capture of spheres, from its truth/; none where that is not known."""
    for file in (capture / "truth" / "sphere.json", capture.parent / "truth" / "sphere.json"):
        if file.is_file():
            return tuple(x["radius"] for x in json.loads(file.read_text())["spheres"])
    return ()


def captures(given: Any, quick: bool) -> tuple[Path | None, Path | None]:
    """Of a plane and of a sphere: those asked for, else those of the same instrument as the session."""
    if given.session is not None or quick:
        return given.plane, given.sphere
    if RENDERED.is_dir():
        return RENDERED / "plane", RENDERED / "sphere"
    made = ROOT / "build" / "studies"
    for scene in ("plane", "sphere"):
        if not (made / scene / "capture.json").is_file():
            simulate(scene, made / scene)
    return made / "plane", made / "sphere"


def main() -> None:
    """Solves a session in every way and judges each rig."""
    ask = arguments(__doc__ or "", "joint_or_single")
    for name, help_ in (("session", "board pictures, or a rig.json that carries its observations"),
                        ("plane", "a capture of a plane"), ("sphere", "a capture of one sphere or more")):  # fmt: skip
        ask.add_argument(f"--{name}", type=Path, help=help_)
    given = ask.parse_args()
    s = Settings()
    if given.quick:
        usual = replace(s.calibrate, lens="k1 k2 p1 p2", projector_lens="k1 k2 p1 p2")
        s, d = replace(s, calibrate=usual), made_up(1, 6, corner_px=0.02, phase_units=0.03)
    else:
        d = look(session_folder(given.session), s)
    plane, sphere = captures(given, given.quick)
    results: dict[str, dict[str, float]] = {}
    for name, (rig, rms) in rigs(d, s).items():
        figures = {"rms of corners, px": rms}
        if d.true is not None:
            figures["points, um"], figures["between views, um"] = against_truth(rig, d.true)
        results[name] = figures | in_captures(rig, plane, sphere, s)
    keys = list(dict.fromkeys(k for r in results.values() for k in r))
    for k in range(0, len(keys), 4):
        print()
        some = keys[k : k + 4]
        table(["", *some], [[n, *(r.get(c, float("nan")) for c in some)] for n, r in results.items()], 29)
    save(given.out, {"poses": len(d.poses), "ways": results}, lambda figure: draw(figure, results, keys), (11, 6))


def draw(figure: Any, results: dict[str, dict[str, float]], keys: list[str]) -> None:
    """One panel of bars per figure."""
    shown = [k for k in keys if k != "plane: std"]
    columns = 4
    axes = figure.subplots(-(-len(shown) // columns), columns, squeeze=False, sharey=True)
    names = list(results)
    for a, key in zip(axes.ravel(), shown, strict=False):
        value = [abs(results[n].get(key, np.nan)) for n in names]
        a.barh(names, value, color=["tab:orange" if n.startswith("OpenCV") else "tab:blue" for n in names])
        a.set_xscale("log")
        a.set_title(key if "px" in key or "um" in key else f"{key}, um", fontsize=9)
        a.grid(alpha=0.3, axis="x")
    for a in axes.ravel()[len(shown) :]:
        a.axis("off")
    axes[0][0].invert_yaxis()


if __name__ == "__main__":
    main()
