"""Verbs that make a rig and ask whether it is still true: calibrate, verify."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fringescope import __version__
from fringescope.cli.app import app
from fringescope.cli.common import (
    Force,
    Json,
    Progress,
    ResponseFile,
    SetOption,
    SettingsFile,
    emit,
    existing,
    load_response,
    load_settings,
)
from fringescope.errors import CalibrationError, CaptureError, DecodeError, FormatError, UsageError

if TYPE_CHECKING:
    from fringescope import evaluate as judging
    from fringescope.calibrate import Sizes
    from fringescope.settings import Settings
    from fringescope.store import CaptureView, Session
    from fringescope.types import F32, U8, Board, Calibration, Evidence, Response, Rig, Sighting

# ----------------------------------------------------------------------------------------------------------- calibrate

WIDEST = 1400  #: pixels of the pictures that are kept for the report


@dataclass
class Looked:
    """What came of looking at a session: sightings, small pictures by "pose/camera", why the others show no board."""

    seen: list[Sighting] = field(default_factory=list)
    pictures: dict[str, F32] = field(default_factory=dict)
    wrong: dict[str, str] = field(default_factory=dict)


def look(session: Session, s: Settings, progress: Progress, response: Response | None = None) -> Looked:
    """Every picture of a session, one after the other; of large ones the raw frames lie on disk, not in memory.

    Frames that cannot be read or decoded cost their own picture, by name.
    """
    from fringescope import pipeline, store

    out = Looked(wrong=dict(session.left_out))
    plain = [(p, replace(c, views=tuple(replace(v, color=None) for v in c.views))) for p, c in session.poses]
    inputs = [
        (pose, v, bytes_of(one))
        for pose, capture in plain
        for v, one in zip(store.view_inputs(capture, response), capture.views, strict=True)
    ]
    for pose, view, size in progress.track(inputs, "looking at the boards", len(inputs)):
        name = f"{pose}/{view.plan.camera}"
        try:
            kept = replace(view, frames=store.spooled(view.frames, size))
            found, mean, why = pipeline.see_board(kept, session.board, pose, s)
        except (CaptureError, DecodeError) as e:
            out.wrong[name] = str(e).removeprefix(f"{name}: ")
            continue
        out.pictures[name] = _reduced(mean)
        if found is None:
            out.wrong[name] = why.removeprefix(f"{name}: ")
        else:
            out.seen.append(found)
    return out


def bytes_of(view: CaptureView) -> int:
    """What all raw frames of a view take in memory."""
    fmt = view.plan.pixel_format
    return len(view.files) * view.size[0] * view.size[1] * fmt.dtype.itemsize * (3 if fmt.value == "RGB8" else 1)


def _reduced(mean: F32) -> F32:
    """Means of n x n pixels, n even, so that a mosaic becomes grey; the picture itself where it is small."""
    import numpy as np

    h, w = mean.shape
    n = -(-max(h, w) // WIDEST)
    if n == 1 or min(h, w) < 4 * n:
        return mean
    n += n % 2
    h, w = h // n * n, w // n * n
    return np.asarray(mean[:h, :w].reshape(h // n, n, w // n, n).mean(axis=(1, 3)), dtype=np.float32)


def overlays(looked: Looked, c: Calibration | None) -> dict[str, U8]:
    """The pictures with what was found in them drawn in."""
    from fringescope import report

    sightings = {x.name: x for x in (c.sightings if c is not None else looked.seen)}
    residuals = {f"{r.pose}/{r.camera}": r for r in (c.residuals if c is not None else ())}
    out = {}
    for name, image in looked.pictures.items():
        pose, camera = name.split("/", 1)
        seen = sightings.get(name) or _nothing(pose, camera, image)
        out[name] = report.sighting_picture(image, seen, residuals.get(name))
    return out


def _nothing(pose: str, camera: str, image: F32) -> Sighting:
    """A sighting without a board."""
    import numpy as np

    from fringescope.types import Sighting

    two, one, index = np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2), np.int32)
    size = (image.shape[1], image.shape[0])
    return Sighting(pose, camera, size, index, two, one, index, two, two, two, two, two, two, two)


def rig_with_evidence(c: Calibration, evidence: Evidence, s: Settings) -> Rig:
    """The solved rig, carrying in its file the board, the observations and the evidence."""
    from fringescope import store
    from fringescope.settings import to_dict

    doc = store.calibration_document(c)
    predicted = evidence.prediction
    doc["calibration"] |= {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {"fringescope": __version__},
        "settings": {k: v for k, v in to_dict(s).items() if k in ("board", "calibrate")},
        "verdict": evidence.verdict,
        "predicted_views_um": {k: m for k, (m, _) in predicted.views_um.items()} if predicted is not None else {},
        "held_out": [asdict(p.held_out) for p in evidence.poses if p.held_out is not None],
    }
    return replace(c.rig, extra={**c.rig.extra, **doc})


@app.command()
def calibrate(
    session: Annotated[
        Path, typer.Argument(help="A folder with board.json and a capture per pose; or a rig.json, to solve it again.")
    ],
    out: Annotated[Path, typer.Option("--out", help="The rig.json to write.", show_default=False)],
    report: Annotated[
        Path | None, typer.Option(help="The report, a page for any browser; else beside the rig, as RIG.html.")
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(metavar="URI", help="The instrument, with the board still under it: a cross grid is shown, too."),
    ] = None,
    response: ResponseFile = None,
    settings: SettingsFile = None,
    set_: SetOption = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Board captures to a calibrated rig, with the evidence to trust it.

    With --device the self-test follows: status 1 if the lines of a cross grid land too far from where they should.
    """
    from fringescope import calibrate as calibrate_

    s = load_settings(settings, set_)
    calibrate_.check(s.calibrate)
    existing(session, "a session: a folder with board.json and a capture per pose")
    page = report if report is not None else out.with_suffix(".html")
    if page.resolve() == out.resolve():
        raise UsageError(f"--report {page} is the rig itself; name another file")
    with Progress() as progress:
        c, evidence, why = calibrate_into(out, page, session, s, progress, load_response(response), force=force)
        told, lines = _told(c, evidence, why, out, page), _lines(c, evidence, why, out, page)
        landed = None if device is None else progress.run("self-test", lambda: cross_grid(device, out, s))
    if landed is not None:
        told["selftest"] = landed
        lines.append(landed["words"])
    emit(told, json, lines)
    if landed is not None and not landed["ok"]:
        raise typer.Exit(1)


def cross_grid(device: str, rig: Path, s: Settings) -> dict[str, Any]:
    """Projects a cross grid on the board under an instrument and measures it: the figures, and a line for people."""
    from fringescope import store
    from fringescope.devices import registry
    from fringescope.pipeline.selftest import self_test

    with registry.open_station(device) as station:
        found = self_test(station, store.read_rig(rig), s)
    figures = {"median_um": found.median_um, "p95_um": found.p95_um, "max_um": found.max_um, "ok": found.ok}
    return {**figures, "limit_um": s.loop.accept_um, "words": found.words(s.loop.accept_um)}


def calibrate_into(
    out: Path, page: Path, session: Path, s: Settings, progress: Progress, response: Response | None = None, *,
    force: bool = False,
) -> tuple[Calibration, Evidence, list[str]]:  # fmt: skip
    """Calibrates a session and writes the rig and its report; returns both, and why pictures were not used.

    Raises CalibrationError where there is no rig; the report, which says why, is written all the same.
    """
    from fringescope import pipeline, store
    from fringescope import report as report_

    title = _title(session.resolve())
    looked, failure = Looked(), ""
    with store.new_file(page, force=force) as page_file:
        try:
            with store.new_file(out, force=force) as rig_file:
                if session.is_file():
                    board, sizes = _observations(session, looked)
                else:
                    found = store.read_session(session)
                    board, sizes = found.board, _sizes(found)
                    looked = look(found, s, progress, response)
                why = [f"{name}: {why}" for name, why in looked.wrong.items()]
                c, evidence = pipeline.calibrate_rig(looked.seen, board, sizes, s, progress.share, why)
                store.write_json(rig_file, store.rig_document(rig_with_evidence(c, evidence, s)))
                text = report_.calibration_page(
                    c, evidence, c.sightings, None, overlays(looked, c), title, looked.wrong
                )
                page_file.write_text(text, encoding="utf-8")
        except (CalibrationError, CaptureError, DecodeError, FormatError) as e:
            if session.is_file() and isinstance(e, FormatError):  # a file, not a session: there is nothing to report on
                raise
            failure = "; ".join([str(e), *_reasons(looked, str(e))])
            text = report_.calibration_page(
                None, None, looked.seen, failure, overlays(looked, None), title, looked.wrong
            )
            page_file.write_text(text, encoding="utf-8")
    if failure:
        raise CalibrationError(f"{failure}; see {page}")
    return c, evidence, why


def _title(session: Path) -> str:
    """What a report is called: by its session's folder, or the one above a session that is named for what it is."""
    plain = session.name.lower() in ("calibration", "session") and session.parent.name
    return f"Calibration of {session.parent.name if plain else session.name}"


def _reasons(looked: Looked, said: str) -> list[str]:
    """Of each camera that the failure `said` names, the most frequent reason why its pictures show no board."""
    of: dict[str, list[str]] = {}
    for name, why in looked.wrong.items():
        if "/" in name:
            of.setdefault(name.split("/", 1)[1], []).append(why)
    out = []
    for camera, every in of.items():
        kinds = Counter(re.sub(r"[\d.]+", "0", why) for why in every)  # the same reason with other figures
        kind, count = kinds.most_common(1)[0]
        why = next(w for w in every if re.sub(r"[\d.]+", "0", w) == kind)
        total = len(every) + sum(s.camera == camera for s in looked.seen)
        if why not in said and (camera in said or 2 * len(every) > total):
            out.append(f"{camera}, {count} of {total} pictures: {why}")
    return list(dict.fromkeys(out))


def _observations(rig: Path, looked: Looked) -> tuple[Board, Sizes]:
    """The board, the sizes and, into `looked`, the sightings that a calibrated rig carries."""
    from fringescope import store
    from fringescope.calibrate import sizes_of

    board, stored = store.read_observations(rig)
    looked.seen.extend(stored)
    return board, sizes_of(store.read_rig(rig))


def _sizes(session: Session) -> Sizes:
    from fringescope.calibrate import Sizes

    first = session.poses[0][1]
    return Sizes((first.projector_width, first.projector_height), first.layout, dict(session.sizes))


def _told(c: Calibration, evidence: Evidence, wrong: list[str], out: Path, page: Path) -> dict[str, Any]:
    return {
        "rig": str(out),
        "report": str(page),
        "verdict": evidence.verdict,
        "good": list(evidence.good),
        "weak": list(evidence.weak),
        "next": list(evidence.next),
        "poses": sorted(c.boards),
        "left_out": [vars(x) for x in c.left_out],
        "not_used": wrong,
        "noise": dict(c.noise),
        "figures": {**c.figures, **evidence.figures},
    }


def _lines(c: Calibration, evidence: Evidence, wrong: list[str], out: Path, page: Path) -> list[str]:
    lines = [f"{out}: {evidence.verdict}; {len(c.boards)} poses, {len(c.rig.cameras)} cameras; report: {page}"]
    lines += [f"without {w}" for w in wrong]
    lines += [f"without {x.pose}{'/' + x.camera if x.camera else ''}"
              f"{_points(x.points)}: {x.why}" for x in c.left_out]  # fmt: skip
    lines += [*evidence.good, *evidence.weak]
    return lines + [f"next: {w}" for w in evidence.next]


def _points(n: int | None) -> str:
    return f" ({n} point{'s' if n > 1 else ''})" if n else ""


# -------------------------------------------------------------------------------------------------------------- verify


def find_board(rig: Rig, capture: Path, board: Path | None) -> Board | None:
    """The board of a capture: the file named, the one beside or above the capture, the one that the rig carries."""
    from fringescope import store

    folder = capture.parent if capture.is_file() else capture
    if board is not None:
        return store.read_board(board)
    for place in (folder, folder.resolve().parent):
        if (place / "board.json").is_file():
            return store.read_board(place / "board.json")
    carried = rig.extra.get("board")
    return store.parse_board(carried, Path("rig.json")) if isinstance(carried, dict) else None


@app.command()
def verify(
    capture: Annotated[Path, typer.Argument(help="A capture of the board, of a sphere, or of anything at all.")],
    rig: Annotated[Path, typer.Option(help="The rig.json that is judged.")],
    board: Annotated[
        Path | None, typer.Option(help="board.json; else the one beside the capture, or that of the rig.")
    ] = None,
    sphere_mm: Annotated[float | None, typer.Option(help="Radius of a sphere that the capture shows, mm.")] = None,
    settings: SettingsFile = None,
    set_: SetOption = None,
    json: Json = False,
) -> None:
    """Is this rig still true? Judged from one capture, with or without a board."""
    from fringescope import pipeline, store

    s = load_settings(settings, set_)
    existing(capture, "a capture")
    existing(rig, "a rig")
    if sphere_mm is not None and not sphere_mm > 0:
        raise UsageError(f"--sphere-mm {sphere_mm}; needed a positive radius in mm")
    with Progress() as progress:
        c, r = store.read_capture(capture), store.read_rig(rig)
        store.check_rig(c, r)
        wanted = find_board(r, capture, board)
        found = pipeline.verify(
            store.view_inputs(c), r, s, wanted, sphere_mm, must_see_board=board is not None, progress=progress.share
        )
    emit(found.to_dict(), json, _verdict_lines(found))


def _verdict_lines(v: judging.Verdict) -> list[str]:
    return [v.verdict, *v.words]
