"""Looking again through the devices: the recipe and the verb."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from fringescope import capture, patterns, pipeline, store
from fringescope.cli import run
from fringescope.devices import base, simulated
from fringescope.errors import CaptureError, IncompleteShotError
from fringescope.pipeline import guidance, projecting, watching
from fringescope.settings import Settings
from fringescope.twin import changes, presets, scene
from fringescope.types import Guidelines, NoiseModel, Scan, Standing, Stroke, ViewInput

S = Settings()
SCALE = 0.05


def world(name: str = "tissue-folded", preset: str = "pair", noise: int = 1) -> simulated.World:
    return simulated.World(scene.make(name, 6), presets.instrument(preset, SCALE), noise, rays=1)


def scanned(
    w: simulated.World, light: bool = True, surface: bool = False
) -> tuple[Scan, dict[str, NoiseModel], dict[str, tuple]]:
    """A scan of a world, and what its figures tell of noise and fringes."""
    rig = w.instrument.rig
    formats = dict(zip([c.name for c in rig.cameras], w.instrument.pixel_formats, strict=True))
    plan = patterns.paper_plan(rig, formats, S.patterns)
    with simulated.station(w) as s:
        images = [patterns.images(v, rig.projector, S.patterns) for v in plan.views]
        views: tuple[ViewInput, ...] = capture.collect(
            s.projector, s.cameras, s.light if light else None, images, plan, S.capture
        )
    made = pipeline.scan(views, rig, S, surface=surface)
    told = made.figures["views"]
    noise = {c: NoiseModel(v["noise"]["a"], v["noise"]["b"]) for c, v in told.items()}
    return made, noise, {c: tuple(tuple(g) for g in v["directions"]) for c, v in told.items()}


@pytest.fixture(scope="module")
def pair() -> tuple[simulated.World, Scan, dict[str, NoiseModel], dict[str, tuple]]:
    w = world()
    return w, *scanned(w)


def again(w: simulated.World, scene_now: scene.Scene | None = None) -> simulated.SimulatedStation:
    """The same instrument with other noise."""
    return simulated.station(simulated.World(scene_now or w.scene, w.instrument, 99, rays=1))


def test_the_recipe_tells_what_happened_while_the_devices_stay_open(pair) -> None:
    w, made, noise, gradients = pair
    rig = w.instrument.rig
    with again(w) as s:
        how = {"noise": noise}
        assert watching.watch(s, made.grids, made.pictures, rig, S, **how).verdict is Standing.VALID
        both = watching.watch(s, made.grids, made.pictures, rig, S, **how, gradients=gradients)
        assert both.verdict is Standing.VALID, both.why
        assert "no depth changed" in both.why
        shift = changes.motion(np.array([0.0, 0.0, 0.3]), np.zeros(3), np.zeros(3))
        s.world.change(changes.moved(w.scene, shift))
        assert s.light is not None
        s.light.set(0.25)
        assert watching.watch(s, made.grids, made.pictures, rig, S, **how).verdict is not Standing.VALID
        assert s.light.level == 0.25
        later = watching.watch(s, made.grids, made.pictures, rig, S, **how, gradients=gradients)
        assert later.verdict is Standing.STALE


def test_a_scan_without_a_ring_light_is_watched_in_the_projectors() -> None:
    w = world(preset="single")
    made, noise, gradients = scanned(w, light=False)
    assert {p.light for p in made.pictures} == {"projector"}
    rig = w.instrument.rig
    with again(w) as s:
        with pytest.raises(CaptureError, match="--remeasure"):
            watching.watch(s, made.grids, made.pictures, rig, S, noise=noise)
        found = watching.watch(s, made.grids, made.pictures, rig, S, noise=noise, gradients=gradients)
        assert found.verdict is Standing.VALID, found.why
        s.world.change(changes.moved(w.scene, changes.motion(np.array([0.3, 0, 0]), np.zeros(3), np.zeros(3))))
        found = watching.watch(s, made.grids, made.pictures, rig, S, noise=noise, gradients=gradients)
        assert found.verdict is Standing.STALE


@pytest.mark.parametrize("name", ["tissue-domed", "tissue-folded", "tissue-thin"])
def test_projected_lines_are_no_change_of_the_specimen(name: str) -> None:
    """White lines over shine, folds and rims, also where a camera has no points: it is VALID all the same."""
    w = world(name, "paper")
    made, noise, _ = scanned(w, surface=True)
    rig, rng = w.instrument.rig, np.random.default_rng(4)
    tissue = guidance.tissue_of(made.grids, made.surface, rig, S)
    rows, columns = np.nonzero(made.grids[0].valid)
    strokes = []
    for k in range(4):
        pick = rng.integers(0, len(rows), 3)
        points = np.stack([columns[pick], rows[pick]], 1).astype(np.float64)
        strokes.append(Stroke(f"s{k}", camera="camera1", pixels=points, width_mm=0.8, color=(255, 255, 255)))
    shown = guidance.project_guidance(Guidelines(tuple(strokes)), tissue, S)
    masks = projecting.lit_masks(shown, tissue)
    with again(w) as s:
        s.projector.show(shown.image)
        how = {"noise": noise}
        found = watching.watch(s, made.grids, made.pictures, rig, S, **how, masks=masks)
        assert found.verdict is Standing.VALID, found.why
        assert watching.watch(s, made.grids, made.pictures, rig, S, **how).verdict is not Standing.VALID
        shift = changes.motion(np.array([0.4, 0.0, 0.0]), np.zeros(3), np.zeros(3))
        s.world.change(changes.moved(w.scene, shift))
        assert watching.watch(s, made.grids, made.pictures, rig, S, **how, masks=masks).verdict is Standing.STALE


def test_a_camera_that_is_missing_makes_it_suspect(pair) -> None:
    w, made, noise, _ = pair
    with again(w) as s:
        one = base.Station(s.projector, s.cameras[:1], s.light)
        found = watching.watch(one, made.grids, made.pictures, w.instrument.rig, S, noise=noise)
    assert found.verdict is Standing.SUSPECT
    assert found.why == "camera2: no picture came"


def test_what_the_recipe_refuses(pair) -> None:
    w, made, _, _ = pair
    rig = w.instrument.rig
    with again(w) as s:
        with pytest.raises(CaptureError, match="needed a picture for each grid"):
            watching.watch(s, made.grids, (), rig, S)
        with pytest.raises(CaptureError, match="this instrument has none"):
            watching.watch(base.Station(s.projector, s.cameras, None), made.grids, made.pictures, rig, S)
        with pytest.raises(CaptureError, match="does not tell its fringes"):
            watching.watch(s, made.grids, made.pictures, rig, S, gradients={})
        assert s.light is not None
        with pytest.raises(CaptureError, match="2 cameras for 1 pixel formats"):
            watching.live_pictures(s.cameras, s.light, [made.pictures[0].pixel_format])
    faults = simulated.Faults(miss={"camera2": frozenset({0})})
    broken = simulated.World(w.scene, w.instrument, 1, rays=1, faults=faults)
    quick = dataclasses.replace(S.capture, timeout_s=0.1)
    with simulated.station(broken) as s:
        assert s.light is not None
        with pytest.raises(IncompleteShotError, match="no picture came"):
            watching.live_pictures(s.cameras, s.light, [p.pixel_format for p in made.pictures], quick)
        assert s.light.level == 0


# ------------------------------------------------------------------------------------------------------------ the verb


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan of a thin sheet by one camera, with its rig beside it."""
    out = tmp_path_factory.mktemp("watch")
    args = ["simulate", "tissue-thin", "--preset", "single", "--scale", "0.05", "--seed", "2", "--out"]
    assert run([*args, str(out / "capture")]) == 0
    rig = str(out / "capture" / "truth" / "rig.json")
    assert run(["reconstruct", str(out / "capture"), "--rig", rig, "--out", str(out / "scan"), "--no-preview"]) == 0
    return out


def verb(stored: Path, *args: str) -> list[str]:
    return ["watch", str(stored / "scan"), "--rig", str(stored / "capture/truth/rig.json"), *args]


def test_watch_says_valid_of_the_instrument_that_took_the_scan(
    stored: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(verb(stored, "--remeasure", "--json", "--picture", str(stored / "w.png"))) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["verdict"] == "VALID"
    assert told["by"] == "picture, fringes"
    assert (stored / "w.png").stat().st_size > 10_000


def test_watch_says_stale_of_what_moved(stored: Path, capsys: pytest.CaptureFixture[str]) -> None:
    uri = store.read_scan(stored / "scan", grids=False).instrument
    assert uri is not None
    assert run(verb(stored, "--device", f"{uri}&move=0.3,0.1,0")) == 1
    out = capsys.readouterr().out
    assert out.startswith("STALE: moved by 0.3")
    assert len(out.splitlines()) == 1
    assert run(verb(stored, "--device", f"{uri}&dent=0.5,4,12", "--remeasure", "--json")) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["verdict"] in ("STALE", "SUSPECT")
    assert told["shift_mm"] > 0.1


def test_watch_refuses_another_rig_and_a_scan_without_pictures(
    stored: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = json.loads((stored / "capture/truth/rig.json").read_text())
    rig["cameras"][0]["t"][2] += 0.1
    (tmp_path / "rig.json").write_text(json.dumps(rig))
    assert run(["watch", str(stored / "scan"), "--rig", str(tmp_path / "rig.json")]) == 1
    assert "not the rig that this scan was made with" in capsys.readouterr().err
    doc_path = stored / "scan" / "scan.json"
    before = doc_path.read_text()
    doc = json.loads(before)
    for v in doc["views"]:
        v["picture"] = None
    doc_path.write_text(json.dumps(doc))
    assert run(verb(stored)) == 1
    assert "reconstruct it again" in capsys.readouterr().err
    del doc["instrument"]
    doc_path.write_text(json.dumps(doc))
    assert run(verb(stored)) == 2
    assert "needed --device URI" in capsys.readouterr().err
    doc_path.write_text(before)
