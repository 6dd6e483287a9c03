"""The recipes: which step comes next. Objects in, objects out; reads like Figs. 6 and 7 of the paper.

Two doors: `scan` does the usual thing in one call; `scan_view`, `decode_view` and the stages that they name are the
parts it is made of. `preview` is what can be shown first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from fringescope import denoise, fuse, geometry, phase, response, specimen, triangulate
from fringescope.errors import CalibrationError, CaptureError, EmptyResultError, UsageError
from fringescope.pipeline import arrival, coarse, fast, pictures
from fringescope.pipeline.fast import Device
from fringescope.settings import Settings
from fringescope.threads import WORKERS
from fringescope.types import (
    F32,
    U16,
    AnyArray,
    Board,
    Calibration,
    Decoded,
    Direction,
    Evidence,
    FrameKey,
    Grid,
    NoiseModel,
    Photo,
    Picture,
    Rig,
    RowFrames,
    Scan,
    Sighting,
    Surface,
    ViewInput,
    ViewPlan,
)

if TYPE_CHECKING:  # they import much of SciPy, which a scan can do without: only the recipes that need them load them
    from fringescope import calibrate, evaluate

T = TypeVar("T")
Progress = Callable[[str, float], None]  #: called with what is being done and the share that is done, 0 to 1


def decode_view(view: ViewInput, s: Settings) -> Decoded:
    """Frames to absolute phase with reasons, without a rig (equations 3 to 5, masks 1 and 3 of III-D).

    Raises CaptureError if frames are missing or do not fit, DecodeError if the sets do not span the projector's field.
    """
    decoded = phase.settle_order(measured_view(view, s), view.plan, s.phase)
    reasons = denoise.exposed(decoded, view.plan.pixel_format, s.denoise)
    reasons = denoise.connected(decoded, reasons, None, s.denoise)
    return phase.with_reasons(decoded, reasons)


def measured_view(view: ViewInput, s: Settings) -> Decoded:
    """One camera's frames, as they come, to wrapped phases, freed from the view's response. Raises CaptureError."""
    return response.corrected(phase.measure(view.frames, view.plan, s.phase, view.noise), view.response)


def scan_view(
    view: ViewInput, rig: Rig, s: Settings, *, device: Device = "cpu", budget: int | None = None
) -> tuple[Decoded, Grid]:
    """One camera's frames to organised points with sigma (Fig. 6, with the masks of Fig. 7).

    `device="gpu"` decodes and triangulates on an NVIDIA GPU, equal within float32's rounding; masks stay here. A plan
    that the fused way does not take goes through the stages, here as well, and a note of the view says so. Frames that
    can give rows (`RowFrames`) and do not fit into `budget` bytes, or what memory is left, are taken some rows at a
    time; the results are the same.
    Raises CaptureError, DecodeError or RigError, each with what came, what was needed and what to do; ResourceError
    where memory does not suffice for the results; UsageError where there is no such device.
    """
    check_device(device)
    geometry.check_baseline(rig, rig.camera(view.plan.camera))
    if budget is not None or isinstance(view.frames, RowFrames):
        (view,) = arrival.fitted([view], rig, budget, alone=True, device=device)
    return scan_gathered(*arrival.gathered(view, rig, s), rig, s, device)  # frames may still be arriving


def scan_gathered(
    view: ViewInput, begun: fast.Begun | None, rig: Rig, s: Settings, device: Device
) -> tuple[Decoded, Grid]:
    """As `scan_view`, of a view as `arrival.gathered` gives it; frames that were gathered are gone once decoded."""
    fused = fast.decode(view, rig, s, device, begun)  # the same in one pass, for the usual plans
    if fused is not None:
        decoded, xyz, sigma, steps = fused
        tiles = denoise.Tiles(decoded, (steps,))
        reasons = _masked(decoded, decoded.reasons, rig, s, tiles)
        grid = triangulate.blanked(xyz, sigma, reasons, rig, decoded.camera)
    else:
        decoded = clean_view(view, rig, s)
        if device == "gpu":
            decoded = replace(decoded, notes=(*decoded.notes, "not on the GPU: a plan for the stages"))
        grid = _points(decoded, rig, s)  # equations 8 to 15
    return phase.with_reasons(decoded, grid.reasons), grid


def check_device(device: str) -> Device:
    """`cpu` or `gpu`, where frames become points. Raises UsageError for others, and where there is no GPU to use."""
    if device == "gpu":
        from fringescope.pipeline import gpu  # CUDA is nobody's business who does not ask for it

        gpu.require()
        return "gpu"
    if device != "cpu":
        raise UsageError(f"device '{device}'; needed cpu or gpu")
    return "cpu"


def clean_view(view: ViewInput, rig: Rig, s: Settings) -> Decoded:
    """One camera's frames to absolute phase, with the reasons of all masks (Fig. 7). Raises as `scan_view`."""
    geometry.check_baseline(rig, rig.camera(view.plan.camera))
    measured = measured_view(view, s)  # II-C; frames may still be arriving
    decoded = phase.settle_order(measured, view.plan, s.phase, rig, s.denoise.volume_margin)
    reasons = denoise.exposed(decoded, view.plan.pixel_format, s.denoise)  # III-D 1
    return phase.with_reasons(decoded, _masked(decoded, reasons, rig, s, denoise.Tiles(decoded)))


def _points(decoded: Decoded, rig: Rig, s: Settings) -> Grid:
    d = s.denoise
    return triangulate.grid(decoded, decoded.reasons, rig, volume_margin=d.volume_margin, rim=d.rim)


def _masked(decoded: Decoded, reasons: U16, rig: Rig, s: Settings, tiles: denoise.Tiles) -> U16:
    """The masks that look at a pixel's neighbours, one after the other; `reasons` change in place."""
    denoise.monotonic(decoded, reasons, rig, s.denoise, tiles, in_place=True)  # III-D 2
    denoise.connected(decoded, reasons, rig, s.denoise, tiles, in_place=True)  # III-D 3
    return denoise.local(decoded, reasons, rig, s.denoise, tiles, in_place=True)


BAND = 1_000_000  #: pixels of a board picture that are decoded at a time
SIMPLE = 2_000_000  #: pixels that suffice to estimate the noise


def see_board(view: ViewInput, board: Board, pose: str, s: Settings) -> tuple[Sighting | None, F32, str]:
    """One camera's frames of the board: its sighting, the mean picture (H, W) in codes, and what is wrong if None.

    Frames are decoded band by band: where `view.frames` can give rows (`RowFrames`), memory does not grow with their
    number. Raises CaptureError or DecodeError for frames that do not fit.
    """
    from fringescope import calibrate

    decoded, mean = decode_bands(view, s)
    try:
        return calibrate.see(decoded, mean, view.plan, board, pose, s.board), mean, ""
    except CalibrationError as e:
        return None, mean, str(e)


def decode_bands(view: ViewInput, s: Settings) -> tuple[Decoded, F32]:
    """As `decode_view` with the masks of exposure alone, in bands of rows, and the mean of the fringe frames (H, W).

    What neighbours say of an order overlaps between the bands. The wrapped sets are not kept (`sets` is empty).
    """
    frames = view.frames if isinstance(view.frames, RowFrames) else list(view.frames)
    _, first = next(iter(frames), (None, np.zeros(0)))
    if not first.size:
        raise CaptureError(f"view '{view.plan.camera}': no frames came")
    H, W = first.shape[:2]
    rows = max(64, BAND // W // 2 * 2)
    noise = view.noise or (_noise_of_rows(view.plan, frames, (H, W), s) if rows < H else None)  # one band tells its own
    overlap = 2 * 4 * (s.phase.order_votes // 2)
    whole: Decoded | None = None
    for row in range(0, H, rows):
        top, end = max(row - overlap, 0), min(row + rows, H)
        below = min(end + overlap, H)
        measured = measured_view(replace(view, frames=_rows(frames, top, below), noise=noise), s)
        decoded = phase.settle_order(measured, view.plan, s.phase)
        decoded = phase.with_reasons(decoded, denoise.exposed(decoded, view.plan.pixel_format, s.denoise))
        whole = whole or phase.room_for(decoded, H)
        phase.put_rows(whole, decoded, row - top, end - top, row)
    assert whole is not None  # a picture has rows
    return whole, phase.mean_picture(frames, view.plan)


def _rows(
    frames: RowFrames | Sequence[tuple[FrameKey, AnyArray]], first: int, last: int
) -> Iterable[tuple[FrameKey, AnyArray]]:
    if isinstance(frames, RowFrames):
        return frames.rows(first, last)
    return [(key, np.ascontiguousarray(f[first:last])) for key, f in frames]


def _noise_of_rows(
    plan: ViewPlan, frames: Iterable[tuple[FrameKey, AnyArray]], shape: tuple[int, int], s: Settings
) -> NoiseModel:
    """The noise from pairs of rows all over the picture (H, W), so that no band has its own."""
    H, W = shape
    pairs = np.arange(0, max(H - 1, 1), 2)
    pairs = pairs[:: max(1, H * W // SIMPLE)]
    rows = np.stack([pairs, np.minimum(pairs + 1, H - 1)], 1).ravel()
    return phase.measure([(k, f[rows]) for k, f in frames], plan, s.phase).noise


def calibrate_rig(
    sightings: Sequence[Sighting],
    board: Board,
    sizes: calibrate.Sizes,
    s: Settings,
    progress: Progress | None = None,
    wrong: Sequence[str] = (),
) -> tuple[Calibration, Evidence]:
    """Sightings of all poses to a rig and the evidence for it. `wrong` says, for messages, what was not seen and why.

    Raises CalibrationError, with what to photograph, where they do not make a rig.
    """
    from fringescope import calibrate

    tell = progress or _silent
    poses: dict[str, list[Sighting]] = {}
    for one in sightings:
        poses.setdefault(one.pose, []).append(one)
    if not poses:
        raise CalibrationError(f"no board was found in any picture; {wrong[0] if wrong else 'the session is empty'}")
    tell("numbering the corners", 0.0)
    agreed = [x for group in poses.values() for x in calibrate.agree(group, board)]
    tell("adjusting all devices and boards at once", 0.1)
    solved = calibrate.solve(agreed, board, sizes, s.calibrate)
    tell("leaving each pose out in turn", 0.4)
    held_out = calibrate.leave_one_out(solved, s.calibrate)
    tell("gathering the evidence", 0.8)
    evidence = calibrate.evidence(solved, held_out, s.evidence)
    tell("done", 1.0)
    return solved, evidence


def verify(
    views: Sequence[ViewInput],
    rig: Rig,
    s: Settings,
    board: Board | None = None,
    sphere_mm: float | None = None,
    *,
    must_see_board: bool = False,
    progress: Progress | None = None,
) -> evaluate.Verdict:
    """Is the rig still true? From one capture: of a board, of a sphere of radius `sphere_mm`, or of anything.

    `must_see_board`: no board found is an error, not a doubt. Raises as `scan_view`, and CalibrationError.
    """
    from fringescope import calibrate, evaluate

    tell = progress or _silent
    grids: list[Grid] = []
    sightings: list[Sighting] = []
    crossed: list[evaluate.EpipolarResidual] = []
    doubts: list[str] = []
    for n, view in enumerate(views):
        tell(f"decoding {view.plan.camera}", n / (len(views) + 1))
        frames = list(view.frames)
        decoded = clean_view(replace(view, frames=frames), rig, s)
        grid, others = _deepest(decoded, rig, s)
        grids.append(grid)
        crossed += [e for d in others if (e := evaluate.epipolar_residual(grid, decoded, d, rig)) is not None]
        if board is not None:
            try:
                mean = phase.mean_picture(frames, view.plan)
                sightings.append(calibrate.see(decoded, mean, view.plan, board, "this capture", s.board))
            except CalibrationError as e:
                doubts.append(f"{view.plan.camera}: {e}")
    tell("comparing", len(views) / (len(views) + 1))
    if board is not None and not sightings and must_see_board:
        raise CalibrationError(f"the board was found in no view; {doubts[0]}")
    trueness = None
    if board is not None and sightings:
        try:
            trueness = evaluate.board_trueness(grids, sightings, board, rig)
        except EmptyResultError as e:
            doubts.append(str(e))
    radius_um = None
    if sphere_mm is not None:
        points = np.concatenate([g.xyz[g.valid] for g in grids])
        radius_um = 1e3 * (evaluate.fit_sphere(points, sphere_mm).radius_mm - sphere_mm)
    if not sightings:  # an ordinary specimen shows no board; that is no doubt
        doubts = []
    blind = tuple(g.camera for g in grids if not g.valid.any())
    views_agree = evaluate.agreement(grids, rig)
    return evaluate.judge(rig, views_agree, s.verify, trueness, radius_um, tuple(crossed), blind, tuple(doubts))


def _deepest(decoded: Decoded, rig: Rig, s: Settings) -> tuple[Grid, list[Direction]]:
    """The points by the direction that tells depth best, and the other directions."""
    best: tuple[float, Grid, int] | None = None
    for i, d in enumerate(decoded.directions):
        one = replace(decoded, directions=(d,))
        grid = _points(one, rig, s)
        sigma = float(np.median(grid.sigma[grid.valid])) if grid.valid.any() else np.inf
        if best is None or sigma < best[0]:
            best = (sigma, grid, i)
    assert best is not None  # settle_order gives one direction at least
    return best[1], [d for i, d in enumerate(decoded.directions) if i != best[2]]


def picture(view: ViewInput, decoded: Decoded, s: Settings) -> Photo:
    """The ring-light picture of a view; where there is none, the background A of its fringes."""
    plan = view.plan
    if view.color is None:
        return fuse.photo_from_background(decoded.background, plan.pixel_format, plan.camera, s.fuse)
    return fuse.photo(phase.unpacked(view.color, plan.pixel_format), plan.pixel_format, plan.camera, s.fuse)


def preview(views: Sequence[ViewInput], rig: Rig, settings: Settings | None = None) -> Surface:
    """The coarse surface, to be shown before the fine one is made: the same steps on thinned frames.

    About `mesh.preview_pixels` of each view take part, see `coarse.thinned`; the textures are as coarse, the vertices
    as exact as any point. Raises EmptyResultError, with the reasons, if no view keeps a point or no triangle is left;
    and as `scan_view`.
    """
    s = settings or Settings()
    first = _Coarse(rig, s)
    first.add(views)
    return first.surface()


class _Coarse:
    """The coarse surface, of views as they come."""

    def __init__(self, rig: Rig, s: Settings) -> None:
        self._rig, self._s = rig, s
        self._thin = rig
        self._made: list[tuple[Grid, Photo, tuple[str, ...]]] = []
        self.views = 0  #: that have come
        self.seconds = 0.0  #: that it took

    def add(self, views: Sequence[ViewInput]) -> None:
        """Views have come, with all their frames. Raises as `scan_view`."""
        start = perf_counter()
        few, self._thin, strides = coarse.thinned(views, self._rig, self._s.mesh.preview_pixels)

        def one(view: ViewInput, n: int) -> tuple[Grid, Photo, tuple[str, ...]]:
            decoded, grid = scan_view(view, self._thin, coarse.settings_for(n, self._s))
            return grid, picture(view, decoded, self._s), decoded.notes

        with ThreadPoolExecutor(WORKERS) as pool:  # little pictures leave cores idle
            self._made += pool.map(one, few, strides)
        self.views += len(views)
        self.seconds += perf_counter() - start

    def surface(self) -> Surface:
        """What the views make together. Raises EmptyResultError."""
        start = perf_counter()
        made, s, thin = sorted(self._made, key=lambda m: m[0].view), self._s, self._thin
        grids = denoise.agree([grid for grid, _, _ in made], thin, s.denoise, in_place=True)
        if not any(g.valid.any() for g in grids):
            words = [w for g in grids for w in denoise.verdict(g).words[1:]]
            words += [f"{g.camera}: {note}" for g, _, notes in made for note in notes]
            raise EmptyResultError("no point was left; " + "; ".join(words))
        out = fuse.preview(fuse.merge(grids, [photo for _, photo, _ in made], thin, s.fuse), thin, s.mesh)
        self.seconds += perf_counter() - start
        return out


def scan(
    views: Sequence[ViewInput],
    rig: Rig,
    settings: Settings | None = None,
    *,
    all_points: bool = False,
    surface: bool = True,
    device: Device = "cpu",
    budget: int | None = None,
    progress: Progress | None = None,
    first: Callable[[Surface], None] | None = None,
) -> Scan:
    """Fringe images of all views to one clean, coloured surface.

    `all_points` also lists every valid pixel of every view, unthinned; `surface=False` leaves out the mesh. Where the
    points are too few or too far apart for a triangle, the surface is None and `figures["surface"]` says why. `device`:
    and `budget`: see `scan_view`. `first` is called with the coarse surface of `preview`, and not called where there
    is none: as soon as all frames have come, and before the fine work on them begins.

    Frames of a view that are neither a list nor a tuple are taken in another thread as they come, view after view in
    their order, while views that are there are worked on. Raises EmptyResultError, with the reasons, if no view keeps a
    point; and as `scan_view`, and what the frames raise.
    """
    s = settings or Settings()
    check_device(device)
    if not views:
        raise EmptyResultError("no view to scan; needed the frames of one camera at least")
    views = arrival.fitted(views, rig, budget, device=device)
    tell = progress or _silent
    times: dict[str, float] = {}
    grids: list[Grid] = []
    photos: list[Photo] = []
    taken: list[Picture] = []
    notes: dict[str, tuple[str, ...]] = {}
    figures: dict[str, Any] = {"views": {}}
    early = _Coarse(rig, s)
    if first is not None:
        tell("coarse surface", 0.0)
        _show_early(early, [view for view in views if arrival.is_here(view)], len(views), first)

    def one(view: ViewInput) -> tuple[Decoded, Grid, Photo, Picture, float]:
        geometry.check_baseline(rig, rig.camera(view.plan.camera))
        come, begun = arrival.gathered(view, rig, s)
        if first is not None and not arrival.is_here(view):
            come = arrival.held(come)
            _show_early(early, [come], len(views), first)
        start = perf_counter()
        decoded, grid = scan_gathered(come, begun, rig, s, device)
        return decoded, grid, picture(come, decoded, s), pictures.taken(come, decoded), perf_counter() - start

    with arrival.each(one, views, rig, at_once=device == "cpu" and first is None) as made:
        for n, view in enumerate(views):
            tell(f"decoding {view.plan.camera}", 0.7 * n / len(views))
            decoded, grid, photo, raw, took = next(made)
            grids.append(grid)
            photos.append(photo)
            taken.append(raw)
            times[f"scan_view {grid.camera}"] = took
            figures["views"][grid.camera] = _figures(view, decoded, grid)
            figures["views"][grid.camera]["interpolated"] = denoise.interpolated(decoded, view.plan.pixel_format)
            notes[grid.camera] = tuple(f"{grid.camera}: {note}" for note in decoded.notes)
    if first is not None:
        times["preview"] = early.seconds
    order = np.argsort([g.view for g in grids])
    grids, photos, taken = ([a[i] for i in order] for a in (grids, photos, taken))
    tell("comparing the views", 0.7)
    start = perf_counter()
    grids = list(denoise.agree(grids, rig, s.denoise, in_place=True))
    verdicts = [denoise.verdict(g, figures["views"][g.camera]["interpolated"]) for g in grids]
    verdicts = [replace(v, words=(*v.words, *notes[v.camera])) for v in verdicts]
    if not any(v.points for v in verdicts):
        raise EmptyResultError("no point was left; " + "; ".join(w for v in verdicts for w in v.words[1:]))
    times["agree"] = perf_counter() - start
    tell("fusing", 0.75)
    start = perf_counter()
    fused = fuse.merge(grids, photos, rig, s.fuse)
    cloud = fuse.cloud(fused)
    every = fuse.all_points(grids, photos, rig, s.fuse) if all_points else None
    times["fuse"] = perf_counter() - start
    start = perf_counter()
    found = specimen.find(cloud.xyz, cloud.normals, cloud.sigma, -rig.projector.pose.R[2], s.specimen)
    figures["specimen"] = specimen.figures(found)
    times["specimen"] = perf_counter() - start
    levels: tuple[Surface, ...] = ()
    if surface:
        tell("meshing", 0.85)
        start = perf_counter()
        try:
            levels = fuse.surface(fused, rig, s.mesh)
        except EmptyResultError as e:  # points too far apart for a triangle are still points
            figures["surface"] = str(e)
        times["mesh"] = perf_counter() - start
    tell("done", 1.0)
    figures["times_s"] = times
    fine, small = (levels[0], levels[-1]) if levels else (None, None)
    return Scan(tuple(grids), cloud, fine, tuple(verdicts), figures, small, every, tuple(taken))


def _show_early(early: _Coarse, views: Sequence[ViewInput], count: int, show: Callable[[Surface], None]) -> None:
    """Views have come; if now all of `count` have, their coarse surface is shown, if they make one."""
    if not views:
        return
    early.add(views)
    if early.views == count:
        try:
            surface = early.surface()
        except EmptyResultError:  # the fine scan may still keep points, or says why not
            return
        show(surface)


def _silent(_what: str, _share: float) -> None:
    """No progress is shown."""


def _figures(view: ViewInput, decoded: Decoded, grid: Grid) -> dict[str, Any]:
    """What scan.json tells of a view: noise; medians of sigma and modulation over every n-th of its points."""
    every = denoise.odd_stride(grid.reasons.size, 1_000_000)
    cut = (slice(None, None, every), slice(None, None, every))
    ok = grid.reasons[cut] == 0
    sigma, A, B = (a[cut][ok] for a in (grid.sigma, decoded.background, decoded.modulation))
    r = view.response
    return {
        "way": "staged" if decoded.sets or decoded.gray else "fused",
        "response": None if r is None else {"gamma": r.gamma, "needed": r.needed},
        "noise": {"a": decoded.noise.a, "b": decoded.noise.b, "source": decoded.noise.source},
        "sigma_median_mm": float(np.median(sigma)) if ok.any() else None,
        "modulation_median": float(np.median(B)) if ok.any() else None,
        "background_median": float(np.median(A)) if ok.any() else None,
        "directions": [list(d.g) for d in decoded.directions],
    }
