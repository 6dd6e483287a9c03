"""The verb that measures the response of projector and camera: response."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from fringescope.cli.app import app
from fringescope.cli.capturing import parse_directions
from fringescope.cli.common import (
    Force,
    Json,
    Progress,
    SetOption,
    SettingsFile,
    emit,
    existing,
    load_settings,
    numbers,
    pixel_format,
    size,
)
from fringescope.errors import CaptureError, DecodeError, EmptyResultError, UsageError

if TYPE_CHECKING:
    from fringescope.report import RippleCurve
    from fringescope.settings import Settings
    from fringescope.types import Decoded, PixelFormat, Response, ViewInput

STAIRCASE_PIXELS = 40_000  #: of a staircase that are looked at


def _steps_of(text: str) -> tuple[float, ...]:
    """ "0,32,64,.." as it is; one number N as N even levels from 0 to 255. Raises UsageError."""
    levels = numbers(text, "--staircase", float)
    if len(levels) > 1:
        return levels
    if not 5 <= levels[0] <= 256 or levels[0] % 1:
        raise UsageError(f"--staircase {text}; needed five or more levels, or how many there are from 0 to 255")
    return tuple(np.linspace(0, 255, int(levels[0])).tolist())


def _read_staircase(folder: Path, levels: Sequence[float], glob: str, fmt: PixelFormat | None) -> tuple[Any, float]:
    """Codes (levels, pixels) of a folder's images, thinned, and the largest code that the format has."""
    from fringescope.importing.loose import LooseFrames, image_files
    from fringescope.types import PixelFormat

    names = [p.name for p in image_files(folder, glob)]
    if len(names) != len(levels):
        raise CaptureError(
            f"{folder}: {len(names)} images for {len(levels)} levels; needed one each: mend --staircase, or pick files "
            "with --glob"
        )
    images = LooseFrames(folder, names, fmt=fmt)
    top = images.fmt.max_value
    thin = max(1, int((images.size[0] * images.size[1] / STAIRCASE_PIXELS) ** 0.5)) | 1
    rows = []
    for i in range(len(images)):
        a = images[i][::thin, ::thin]
        rows.append((a.max(axis=2) if images.fmt is PixelFormat.RGB8 else a).ravel())
    return np.stack(rows), float(top)


def _views(source: Path, recipe_of: dict[str, Any]) -> tuple[ViewInput, ...]:
    """The views of a capture folder, or of a folder of loose images by what the options say of them."""
    from fringescope import importing, store
    from fringescope.importing.loose import Recipe
    from fringescope.types import Layout

    if (source / "capture.json").is_file() or source.is_file():
        given = [o for o in ("steps", "periods", "step_order") if recipe_of[o]]
        if given:
            raise UsageError(f"{source} is a capture: it says its steps and periods itself; leave out --{given[0]}")
        return store.view_inputs(store.read_capture(source))
    if not (recipe_of["steps"] and recipe_of["periods"]):
        raise UsageError(
            f"{source}: no capture.json; needed --staircase, or --steps and --periods of the fringes in the folder"
        )
    recipe = Recipe(
        numbers(recipe_of["steps"], "--steps", int),
        numbers(recipe_of["periods"], "--periods", float),
        parse_directions(recipe_of["direction"], None),
        size(recipe_of["projector"], "--projector"),
        Layout.GRID,
        step_order=numbers(recipe_of["step_order"], "--step-order", int) if recipe_of["step_order"] else (),
    )
    found = importing.find_views(source, recipe, pattern=recipe_of["glob"], pixel_format=recipe_of["pixel_format"])
    return tuple(v.view_input(recipe) for v in found)


def _settled(view: ViewInput, s: Settings) -> Decoded:
    """A view's phases with their orders; without them where the sets do not settle them."""
    from fringescope import phase

    measured = phase.measure(view.frames, view.plan, s.phase, view.noise)
    try:
        return phase.settle_order(measured, view.plan, s.phase)
    except DecodeError:
        return measured


def _of_view(
    view: ViewInput, exponents: tuple[float, ...], levels: tuple[float, float], s: Settings, draw: bool
) -> tuple[Response, list[RippleCurve]]:
    """A view's response; with `draw` also the ripples of its directions before and after."""
    from fringescope import phase, response

    decoded = _settled(view, s)
    if exponents:
        count = len(decoded.sets)
        each = exponents * (count // len(exponents)) if count % len(exponents) == 0 else exponents
        return response.from_exponents(decoded, each, s.response, levels), []
    found = response.from_fringes(decoded, view.frames, view.plan, s.response, levels)
    if not (draw and decoded.directions):
        return found, []
    mended = response.corrected(replace(decoded, directions=()), replace(found, needed=True))
    after = phase.settle_order(mended, view.plan, s.phase)
    return found, _plane_ripples(decoded, after)


def _plane_ripples(before: Decoded, after: Decoded) -> list[RippleCurve]:
    """What each direction's phase deviates from a smooth surface by; empty where the surface is no plane."""
    from fringescope import response
    from fringescope.report import RippleCurve

    out = []
    for i in range(len(before.directions)):
        try:
            a, b = response.plane_ripple(before, i), response.plane_ripple(after, i)
        except EmptyResultError:
            continue
        title = f"{before.camera}, smooth surface: {a.amplitude:.4f} to {b.amplitude:.4f} rad"
        if b.rest < 0.3:
            out.append(RippleCurve(title, a.phase, a.mean, b.mean))
    return out


def _pair_curves(found: Response) -> list[RippleCurve]:
    from fringescope.report import RippleCurve

    return [
        RippleCurve(
            f"period {p['periods'][0]:.4g} against {p['periods'][1]:.4g}: "
            f"{p['median_before']:.3g} to {p['median_after']:.3g} units",
            p["phase"],
            p["before"],
            p["after"],
        )
        for p in found.figures.get("pairs", [])
    ]


def _best(found: dict[str, Response]) -> tuple[str, Response]:
    """The view that tells the three-step error most surely; says so where views contradict each other."""
    name = min(found, key=lambda c: found[c].error_sigma[3])
    best = found[name]
    extra = []
    for camera, r in found.items():
        apart = abs(r.error_rad[3] - best.error_rad[3])
        if apart > 0.02 and apart > 4 * (r.error_sigma[3] ** 2 + best.error_sigma[3] ** 2) ** 0.5:
            extra.append(f"{camera} sees another response ({r.error_rad[3]:.3f} rad at N = 3): correct it by its own")
    return name, replace(best, words=(*best.words, *extra), needed=any(r.needed for r in found.values()))


@app.command()
def response(
    source: Annotated[
        Path, typer.Argument(metavar="CAPTURE_OR_FOLDER", help="A capture, or a folder of images of fringes or levels.")
    ],
    out: Annotated[Path, typer.Option("--out", help="The response.json to write.", show_default=False)],
    report: Annotated[Path | None, typer.Option(help="Also a PNG: curve, harmonics, ripple before and after.")] = None,
    staircase: Annotated[
        str | None, typer.Option(help="The images are uniform levels: 0,32,64,.. or how many from 0 to 255.")
    ] = None,
    exponents: Annotated[
        str | None, typer.Option(help="The sets of a white plane were drawn to these powers, as in 1.3333,0.8.")
    ] = None,
    drawn: Annotated[
        str,
        typer.Option(help="The fringes to be corrected are drawn to this power (1: plain sinusoids); measured: to the "
                     "gamma that this run finds, as tools draw that were set to their own measurement."),
    ] = "1",
    levels: Annotated[str, typer.Option(help="Darkest and brightest level drawn, of 255.")] = "0,255",
    steps: Annotated[str | None, typer.Option(help="Of loose images: steps of each set, as in 3,3.")] = None,
    periods: Annotated[str | None, typer.Option(help="Of loose images: period of each set, as in 240,240.")] = None,
    direction: Annotated[str, typer.Option(help='Of loose images: u, v, gx,gy or "u,v" in turn.')] = "u",
    step_order: Annotated[str | None, typer.Option(help="Which image of a set comes when, as in 1,0,2.")] = None,
    projector: Annotated[str, typer.Option(help="Of loose images: device pixels, WIDTHxHEIGHT.")] = "912x1140",
    glob: Annotated[str, typer.Option(help="Of loose images: which files.")] = "*",
    pixel_format_: Annotated[str | None, typer.Option("--pixel-format", help="Of loose images: as Mono12.")] = None,
    settings: SettingsFile = None,
    set_: SetOption = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Measures the response of projector and camera (gamma, saturation) and tells whether phases need its correction.

    From a capture's own fringes, from fringes drawn to known powers, or from a staircase of grey levels.
    """
    from fringescope import response as stage
    from fringescope import store

    s = load_settings(settings, set_)
    existing(source, "a capture or a folder of images")
    span = numbers(levels, "--levels", float)
    if len(span) != 2 or not 0 <= span[0] < span[1] <= 255:
        raise UsageError(f"--levels {levels}; needed the darkest and the brightest of 0 to 255, as in 8,247")
    given = None if drawn == "measured" else _power(drawn)
    if staircase is not None and exponents is not None:
        raise UsageError("--staircase and --exponents: needed one of them")
    fmt, drawn_levels = pixel_format(pixel_format_), (span[0] / 255, span[1] / 255)
    curves: list[RippleCurve] = []
    with Progress() as progress:
        if staircase is not None:
            asked = _steps_of(staircase)
            codes, top = _read_staircase(source, asked, glob, fmt)
            work = lambda: stage.from_staircase(asked, codes, s.response, max_code=top)  # noqa: E731
            name, found = "", progress.run("measuring", work)
            every: dict[str, Response] = {}
        else:
            recipe = {"steps": steps, "periods": periods, "direction": direction, "step_order": step_order,
                      "projector": projector, "glob": glob, "pixel_format": fmt}  # fmt: skip
            views = _views(source, recipe)
            powers = numbers(exponents, "--exponents", float) if exponents else ()
            every = {}
            failed: list[str] = []
            for v in progress.track(views, "measuring", len(views)):
                try:
                    every[v.plan.camera], more = _of_view(v, powers, drawn_levels, s, report is not None)
                except EmptyResultError as e:
                    failed.append(str(e))
                    continue
                curves += _pair_curves(every[v.plan.camera]) + more
            if not every:
                raise EmptyResultError(f"{source}: " + "; ".join(failed))
            name, found = _best(every)
        table = stage.predistortion(found).tolist()  # the device's own, whatever the fringes are drawn to
        power = found.gamma if given is None else given
        if power != 1.0:
            found = stage.as_drawn(found, power, s.response)
        doc = store.response_document(found, table) | {
            "camera": name,
            "drawn_to_power": power,
            "views": {c: _brief(r) for c, r in every.items()},
        }
        if report is not None:
            x = np.linspace(0, 1, 256)
            picture = lambda: _picture(found, (x, stage.curve(found, x)), curves, source)  # noqa: E731
            with store.new_file(report, force=force) as tmp:
                store.write_png(tmp, progress.run("drawing", picture))
        with store.new_file(out, force=force) as tmp:
            store.write_json(tmp, doc)
    emit({"response": str(out), **doc}, json, [f"{out}: from {found.source}, {found.pixels} pixels", *found.words])


def _power(text: str) -> float:
    """The number of --drawn. Raises UsageError."""
    try:
        power = float(text)
    except ValueError:
        power = 0.0
    if not 0.05 <= power <= 20:
        raise UsageError(f"--drawn {text}; needed a power of 0.05 to 20, or measured")
    return power


def _brief(r: Response) -> dict[str, Any]:
    return {"gamma": r.gamma, "error_rad": dict(r.error_rad), "error_sigma": dict(r.error_sigma), "needed": r.needed}


def _picture(found: Response, curve: tuple[Any, Any], curves: Sequence[RippleCurve], source: Path) -> Any:
    from fringescope import report

    return report.response_picture(found, curve, curves[:9], f"Response, from {source.resolve().name}")
