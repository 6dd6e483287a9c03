"""Verbs up to a capture: simulate, import, patterns, devices, settings."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fringescope.cli.app import app
from fringescope.cli.common import (
    Force,
    Json,
    Out,
    Progress,
    SetOption,
    SettingsFile,
    emit,
    load_settings,
    numbers,
    pixel_format,
    say,
    size,
)
from fringescope.errors import CaptureError, UsageError

if TYPE_CHECKING:
    from fringescope.devices.simulated import World
    from fringescope.importing import Evidence, ImportedView, Recipe
    from fringescope.settings import Settings
    from fringescope.types import PatternPlan, PixelFormat, ViewInput


# ------------------------------------------------------------------------------------------------------------ simulate


def simulate_into(folder: Path, world: World, plan: PatternPlan, s: Settings, progress: Progress) -> None:
    """Records a plan on a simulated instrument and writes capture and truth into a folder that is being made."""
    from fringescope import capture, patterns, store
    from fringescope.devices import simulated
    from fringescope.twin import truth
    from fringescope.types import ViewInput

    rig = world.instrument.rig
    p = rig.projector
    with simulated.station(world) as station:
        formats = [v.pixel_format for v in plan.views]
        light = station.light
        assert light is not None  # the twin has a ring light
        photos = progress.run(
            "ring light",
            lambda: capture.photograph(station.projector, station.cameras, light, formats, s.capture),
        )

        def views() -> Iterator[ViewInput]:
            for view, camera, photo in zip(plan.views, station.cameras, photos, strict=True):
                shown = patterns.images(view, p, s.patterns)
                frames = capture.stream(station.projector, camera, shown, view, s.capture)
                yield ViewInput(view, progress.track(frames, f"capture {view.camera}", len(view.keys)), photo)

        extra = {"instrument": world.uri} if world.uri else None
        store.put_capture(folder, p.width, p.height, p.layout, views(), extra)
    truth.write(world.scene, rig, folder / "truth")


def simulate_session(folder: Path, poses: int, make: Callable[[int], World], s: Settings, progress: Progress) -> None:
    """A calibration session: a capture per pose of the board, board.json, the truth of all poses together."""
    from fringescope import store
    from fringescope.store import files

    truth = []
    for pose in range(poses):
        world = make(pose)
        here = folder / f"pose{pose:02d}"
        here.mkdir()
        progress("poses", pose, poses)
        simulate_into(here, world, make_plan(world, s), s, Progress())
        truth += world.scene.truth["poses.json"]
        if pose == 0:
            (folder / "truth").mkdir()
            (here / "truth" / "rig.json").rename(folder / "truth" / "rig.json")
            store.write_json(folder / files.BOARD, world.scene.truth["board.json"])
        shutil.rmtree(here / "truth")
    store.write_json(folder / "truth" / "poses.json", truth)
    progress("poses", poses, poses)


def make_world(scene: str, preset: str, scale: float, seed: int, layout: str, pose: int, board: str) -> World:
    """A simulated instrument over a scene. Raises UsageError."""
    from fringescope.devices import simulated
    from fringescope.twin import presets
    from fringescope.twin import scene as scenes
    from fringescope.types import Layout

    if layout not in ("grid", "diamond"):
        raise UsageError(f"--layout {layout}; needed grid or diamond")
    instrument = presets.instrument(preset, scale, Layout(layout))
    noise_seed = seed + 1_000_003 * pose  # the poses of a session share no noise
    options = {"scale": scale, "seed": seed, "layout": layout, "noise": 2}
    options |= {"pose": pose, "board": board} if scene == "board" else {}
    uri = f"sim://{preset}/{scene}?" + "&".join(f"{k}={v}" for k, v in options.items())
    return simulated.World(scenes.make(scene, seed, pose=pose, board=board), instrument, noise_seed, uri=uri)


def make_plan(world: World, s: Settings) -> PatternPlan:
    """What to project over a scene: the paper's plan, or for a board both directions."""
    from fringescope import patterns

    rig = world.instrument.rig
    formats = {c.name: f for c, f in zip(rig.cameras, world.instrument.pixel_formats, strict=True)}
    if world.scene.name == "board":
        p = rig.projector
        return patterns.calibration_plan((p.width, p.height), p.layout, list(formats), formats, s.patterns)
    return patterns.paper_plan(rig, formats, s.patterns)


@app.command()
def simulate(
    scene: Annotated[
        str,
        typer.Argument(
            help="plane, sphere, steps, board, tissue-domed, tissue-folded or tissue-thin; or a whole URI, as "
            "'sim://paper/tissue-thin?seed=3&move=1,0,0', which says all of it."
        ),
    ],
    out: Out,
    preset: Annotated[str, typer.Option(help="Instrument: paper, single, pair or five.")] = "paper",
    scale: Annotated[float, typer.Option(help="Of the sensors' pixels: 0.125 is 684 x 456.")] = 0.125,
    seed: Annotated[int, typer.Option(help="Of the scene and all noise.", min=0)] = 0,
    layout: Annotated[str, typer.Option(help="Projector lattice: diamond or grid.")] = "diamond",
    pose: Annotated[int, typer.Option(help="Which pose of the board.", min=0)] = 0,
    poses: Annotated[
        int, typer.Option(help="Of the board: a whole calibration session of so many poses.", min=0, max=100)
    ] = 0,
    board: Annotated[str, typer.Option(help="checkerboard or charuco.")] = "checkerboard",
    settings: SettingsFile = None,
    set_: SetOption = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """A capture of the simulated instrument, with its exact truth in truth/."""
    from fringescope import store
    from fringescope.devices import simulated

    s = load_settings(settings, set_)
    if scene.startswith("sim://"):
        usual = {"preset": "paper", "scale": 0.125, "seed": 0, "layout": "diamond", "pose": 0, "board": "checkerboard"}
        given = {"preset": preset, "scale": scale, "seed": seed, "layout": layout, "pose": pose, "board": board}
        for name in usual:
            if given[name] != usual[name]:
                raise UsageError(f"--{name} {given[name]} with {scene}; a URI says all of it: put it there")
    if poses:
        if scene != "board":
            raise UsageError(f"--poses {poses} of {scene}; a session shows a board: simulate board --poses {poses}")

        def make(number: int) -> World:
            return make_world(scene, preset, scale, seed, layout, number, board)

        with Progress() as progress, store.new_folder(out, marker="board.json", force=force) as tmp:
            simulate_session(tmp, poses, make, s, progress)
        told = {"session": str(out), "rig": str(out / "truth" / "rig.json"), "scene": scene, "poses": poses}
        emit(told, json, [f"{out}: a session of {poses} poses", f"rig: {out / 'truth' / 'rig.json'}"])
        return
    with Progress() as progress, store.new_folder(out, marker="capture.json", force=force) as tmp:
        if scene.startswith("sim://"):
            world = simulated.parse(scene)
        else:
            world = make_world(scene, preset, scale, seed, layout, pose, board)
        simulate_into(tmp, world, make_plan(world, s), s, progress)
    c = store.read_capture(out)
    views = [{"camera": v.camera, "size": v.size, "frames": len(v.files)} for v in c.views]
    frames = sum(len(v.files) for v in c.views)
    emit(
        {"capture": str(out), "rig": str(out / "truth" / "rig.json"), "scene": scene, "views": views},
        json,
        [f"{out}: {frames} frames of {len(views)} views", f"rig: {out / 'truth' / 'rig.json'}"],
    )


# -------------------------------------------------------------------------------------------------------------- import


def parse_directions(direction: str, angle: float | None) -> tuple[tuple[float, float], ...]:
    """ "u", "v", "u,v" or "0.8,0.6" (or an angle in degrees from u to v) to unit gradients. Raises UsageError."""
    if angle is not None:
        return ((math.cos(math.radians(angle)), math.sin(math.radians(angle))),)
    words = [w.strip().lower() for w in direction.split(",")]
    if words and all(w in ("u", "v") for w in words):
        return tuple((1.0, 0.0) if w == "u" else (0.0, 1.0) for w in words)
    try:
        gx, gy = (float(w) for w in words)
    except ValueError:
        raise UsageError(f'--direction {direction}; needed u, v, "u,v" or two numbers gx,gy') from None
    length = math.hypot(gx, gy)
    if not (math.isfinite(length) and length > 0):
        raise UsageError(f"--direction {direction}; needed two numbers, not both zero")
    return ((gx / length, gy / length),)


@app.command("import")
def import_(
    source: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Images, folders of images (one per camera), or a TIFF stack.")
    ],
    steps: Annotated[str, typer.Option(help="Steps of each set, as in 4 or 4,4,8.")],
    periods: Annotated[str, typer.Option(help="Period of each set in projector-plane units, as in 1140,200,36.")],
    out: Out,
    direction: Annotated[
        str, typer.Option(help='Fringe gradient: u, v, gx,gy, or "u,v" for two directions in turn.')
    ] = "u",
    angle: Annotated[float | None, typer.Option(help="Instead: its angle from u to v in degrees.")] = None,
    projector: Annotated[str, typer.Option(help="Device pixels, WIDTHxHEIGHT.")] = "912x1140",
    layout: Annotated[str, typer.Option(help="Projector lattice: grid or diamond.")] = "grid",
    camera: Annotated[str, typer.Option(help="Name of the camera, as in the rig.")] = "camera1",
    pixel_format_: Annotated[
        str | None, typer.Option("--pixel-format", help="As Mono8, Mono12, BayerRG8, RGB8.")
    ] = None,
    left_aligned: Annotated[bool, typer.Option("--left-aligned", help="10 or 12 bits lie in the upper bits.")] = False,
    glob: Annotated[str, typer.Option(help="Which files.")] = "*",
    order: Annotated[str, typer.Option(help="sets (all steps of the first set, then ..) or interleaved.")] = "sets",
    step_order: Annotated[str | None, typer.Option(help="Which image of a set comes when, as in 1,0,2.")] = None,
    reverse_steps: Annotated[
        bool, typer.Option("--reverse-steps", help="The steps of all sets run backwards.")
    ] = False,
    reverse_sets: Annotated[str | None, typer.Option(help="Sets (from 0) whose steps run backwards.")] = None,
    first_phase: Annotated[float, typer.Option(help="Shift of each set's first image, degrees.")] = 0.0,
    color: Annotated[str | None, typer.Option(help="File name of the ring-light picture.")] = None,
    gray: Annotated[str | None, typer.Option(help="Gray code after the fringes, along u or v.")] = None,
    gray_cell: Annotated[float, typer.Option(help="Width of one code value, projector-plane units.")] = 1.0,
    gray_bits: Annotated[int, typer.Option(help="Number of bits, most significant first.")] = 0,
    gray_inverse: Annotated[str, typer.Option(help="Inverse frames: none, pairs or after.")] = "none",
    gray_white_black: Annotated[
        bool, typer.Option("--gray-white-black", help="A white and a black frame come first.")
    ] = False,
    axis: Annotated[str | None, typer.Option(help="Axis of a stack along which the steps lie, as Z.")] = None,
    time: Annotated[int | None, typer.Option(help="Which time of a stack.")] = None,
    as_given: Annotated[
        bool, typer.Option("--as-given", help="Import even if another order fits clearly better.")
    ] = False,
    force: Force = False,
    json: Json = False,
) -> None:
    """Somebody's loose images, or a TIFF stack, to a capture, with a preview and a proof that the order is right.

    Frame n of a set is A + B cos(Phi - first phase - 2 pi n / N). Where another order fits clearly better, nothing is
    written and the options that would mend it are named.
    """
    from fringescope import importing, store
    from fringescope.store.files import check_name
    from fringescope.types import Layout

    if layout not in ("grid", "diamond"):
        raise UsageError(f"--layout {layout}; needed grid or diamond")
    if order not in ("sets", "interleaved"):
        raise UsageError(f"--order {order}; needed sets or interleaved")
    if bad := check_name(camera):
        raise UsageError(f"--camera {camera}: {bad}")
    code = None
    if gray is not None:
        code = importing.Gray(gray, gray_cell, gray_bits, gray_inverse, gray_white_black)
    recipe = importing.Recipe(
        numbers(steps, "--steps", int),
        numbers(periods, "--periods", float),
        parse_directions(direction, angle),
        size(projector, "--projector"),
        Layout(layout),
        order == "interleaved",
        numbers(step_order, "--step-order", int) if step_order else (),
        numbers(reverse_sets, "--reverse-sets", int) if reverse_sets else (),
        first_phase,
        code,
    )
    if reverse_steps:
        recipe = recipe.reversed()
    with store.new_folder(out, marker="capture.json", force=force) as tmp, Progress() as progress:
        views = importing.find_views(
            source,
            recipe,
            camera=camera,
            pattern=glob,
            pixel_format=pixel_format(pixel_format_),
            left_aligned=left_aligned,
            color=color,
            axis=axis,
            time=time,
        )
        weighed = progress.track(views, "weighing the order", len(views))
        evidence = {v.camera: importing.look(v.images, recipe) for v in weighed}
        _refuse_doubtful(evidence, as_given)
        progress.run("write", lambda: importing.put_import(tmp, views, recipe, evidence))
    lines = [f"{out}: {_told(views, recipe)}"]
    for v in views:
        e = evidence[v.camera]
        lines += [f"{v.camera}: {note}" for note in v.notes]
        lines += [f"{v.camera}: the order is {e.verdict}", *(f"  + {w}" for w in e.proved)]
        lines += [*(f"  - {w}" for w in e.against), *(f"  ? {w}" for w in e.notes)]
        lines.append(f"  preview: {out / f'import-{v.camera}.png'}")
    found = {c: e.figures() for c, e in evidence.items()}
    notes = {v.camera: list(v.notes) for v in views}
    emit({"capture": str(out), "views": found, "notes": notes}, json, lines)


def _told(views: tuple[ImportedView, ...], recipe: Recipe) -> str:
    v = views[0].images
    return f"{len(views)} view(s) of {recipe.files_needed} frames, {v.size[0]} x {v.size[1]} {v.fmt.value}"


def _refuse_doubtful(evidence: dict[str, Evidence], as_given: bool) -> None:
    for camera, e in evidence.items():
        if e.verdict != "doubtful":
            continue
        use = f"; use {' and '.join(e.options)}" if e.options else ""
        if not as_given:
            raise CaptureError(
                f"{camera}: the order looks wrong: {'; '.join(e.against)}{use} (or --as-given to import anyway)"
            )
        say(f"{camera}: the order looks wrong: {'; '.join(e.against)}{use}")


# ------------------------------------------------------------------------------------------------ patterns and devices


@app.command()
def patterns(
    out: Out,
    rig: Annotated[
        Path | None, typer.Argument(help="A rig.json; not needed for --plan calibration with --projector.")
    ] = None,
    plan: Annotated[str, typer.Option(help="paper (Table I), planned, horizontal or calibration.")] = "paper",
    projector: Annotated[
        str | None, typer.Option(help="Without a rig: the projector's device pixels, as 912x1140.")
    ] = None,
    layout: Annotated[str, typer.Option(help="Without a rig: the projector's lattice, diamond or grid.")] = "grid",
    pixel_format_: Annotated[str, typer.Option("--pixel-format", help="Of the cameras.")] = "BayerRG8",
    background: Annotated[float, typer.Option(help="A expected on the specimen, 8-bit codes.", min=0)] = 70,
    modulation: Annotated[float, typer.Option(help="B expected on the specimen, 8-bit codes.", min=0.1)] = 50,
    settings: SettingsFile = None,
    set_: SetOption = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """The images to project for a rig, as the device needs them, with the plan that they follow."""
    from fringescope import patterns as p
    from fringescope import store
    from fringescope.types import NoiseModel, PixelFormat

    s = load_settings(settings, set_)
    fmt = pixel_format(pixel_format_) or PixelFormat.BAYER_RG8
    if rig is None:
        _calibration_patterns(out, plan, projector, layout, fmt, s, force, json)
        return
    if projector is not None:
        raise UsageError(f"--projector {projector}: the rig says it; leave out one of them")
    r = store.read_rig(rig)
    size_ = (r.projector.width, r.projector.height)
    cameras = [c.name for c in r.cameras]
    plans = {
        "paper": lambda: p.paper_plan(r, fmt, s.patterns),
        "planned": lambda: p.plan(r, fmt, s.patterns),
        "horizontal": lambda: p.horizontal_plan(r, fmt, s.patterns),
        "calibration": lambda: p.calibration_plan(size_, r.projector.layout, cameras, fmt, s.patterns),
    }
    if plan not in plans:
        raise UsageError(f"--plan {plan}; needed one of {', '.join(plans)}")
    with Progress() as progress, store.new_folder(out, marker="plan.json", force=force) as tmp:
        planned = plans[plan]()
        total = sum(len(v.keys) for v in planned.views)
        doc = store.put_patterns(tmp, planned, progress.track(p.plan_images(planned, s.patterns), "patterns", total))
    lines, expected = [f"{out}: {total} images for {len(planned.views)} views"], []
    if plan != "calibration":  # what a grey spot in the middle of the volume will give, before anything is captured
        codes = fmt.full_scale / 255
        noise = NoiseModel(0.25 * codes**2, 0.016 * codes)
        for view in planned.views:
            a = p.predict(r, view, noise, modulation * codes, background * codes)
            expected.append({
                "camera": a.camera, "sigma_um": 1000 * float(a.depth_sigma_mm[0]), "wrong_orders": a.order_error,
                "gain_over_horizontal": float(a.gain_over_horizontal[0]),
            })  # fmt: skip
            wrong = f"{100 * a.order_error:.2g} %" if a.order_error > 1e-6 else "below 0.0001 %"
            lines.append(
                f"{a.camera}: sigma {1000 * a.depth_sigma_mm[0]:.1f} um, wrong orders {wrong}, "
                f"{a.gain_over_horizontal[0]:.2f} times better than horizontal fringes"
            )
    warnings = [] if plan == "calibration" else list(p.validate(planned, r, s.patterns))
    told = {"patterns": str(out), "expected": expected, "warnings": warnings, **doc}
    emit(told, json, [*lines, *warnings])


def _calibration_patterns(
    out: Path, plan: str, projector: str | None, layout: str, fmt: PixelFormat, s: Settings, force: bool, json: bool
) -> None:
    """What a board session needs of a projector of which nothing is known but its pixels; the same for all cameras."""
    from fringescope import patterns as p
    from fringescope import store
    from fringescope.types import Layout

    if plan != "calibration" or projector is None:
        raise UsageError(f"--plan {plan} without a rig; needed RIG, or --plan calibration --projector WIDTHxHEIGHT")
    if layout not in ("grid", "diamond"):
        raise UsageError(f"--layout {layout}; needed grid or diamond")
    planned = p.calibration_plan(size(projector, "--projector"), Layout(layout), ["every-camera"], fmt, s.patterns)
    total = len(planned.views[0].keys)
    with Progress() as progress, store.new_folder(out, marker="plan.json", force=force) as tmp:
        doc = store.put_patterns(tmp, planned, progress.track(p.plan_images(planned, s.patterns), "patterns", total))
    emit({"patterns": str(out), **doc}, json, [f"{out}: {total} images, the same for every camera"])


@app.command()
def devices(json: Json = False) -> None:
    """The devices that can be opened, by URI."""
    from fringescope.twin import presets, scene

    found = [{"uri": f"sim://{p}/{n}", "kind": "simulated instrument"} for p in presets.names() for n in scene.names()]
    emit({"devices": found}, json, [f"{d['uri']:32} {d['kind']}" for d in found])


@app.command("settings")
def settings_(settings: SettingsFile = None, set_: SetOption = None, json: Json = False) -> None:
    """Every threshold with its value, unit and meaning, as the YAML that --settings takes."""
    from fringescope.settings import to_dict, to_yaml

    s = load_settings(settings, set_)
    emit(to_dict(s), json, [to_yaml(s).rstrip()])
