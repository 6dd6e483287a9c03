"""The command line: what each verb leaves, JSON on stdout, progress on stderr, exit status."""

from __future__ import annotations

import dataclasses
import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from fringescope import export, geometry, pipeline, store
from fringescope.capture import photograph
from fringescope.cli import run
from fringescope.cli.capturing import make_world
from fringescope.cli.common import Progress, load_settings
from fringescope.cli.showing import errors
from fringescope.devices import registry
from fringescope.devices.simulated import parse as world_of
from fringescope.errors import UsageError
from fringescope.settings import from_yaml, to_dict
from fringescope.twin import scene
from fringescope.types import Cloud, Grid, Scan

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/data is absent")


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small capture of a plane by two cameras."""
    out = tmp_path_factory.mktemp("cli") / "capture"
    assert run(["simulate", "plane", "--preset", "pair", "--scale", "0.04", "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def scan(simulated: Path) -> Path:
    """Its reconstruction."""
    out = simulated.parent / "scan"
    rig = simulated / "truth" / "rig.json"
    assert run(["reconstruct", str(simulated), "--rig", str(rig), "--out", str(out)]) == 0
    return out


def answer(args: list[str], capsys: pytest.CaptureFixture[str]) -> Any:
    """The one JSON object that a verb prints."""
    assert run([*args, "--json"]) == 0
    out = capsys.readouterr().out
    assert len(out.splitlines()) == 1
    return json.loads(out)


def test_simulate_leaves_a_capture_with_its_truth(simulated: Path) -> None:
    capture = store.read_capture(simulated)
    rig = store.read_rig(simulated / "truth" / "rig.json")
    store.check_rig(capture, rig)
    assert [v.size for v in capture.views] == [(219, 146)] * 2
    assert all(v.color for v in capture.views)
    assert (simulated / "truth" / "plane.json").is_file()


def test_some_views_of_a_capture(simulated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A capture may hold more cameras than the rig, or than one wants."""
    rig = json.loads((simulated / "truth" / "rig.json").read_text())
    rig["cameras"] = [c for c in rig["cameras"] if c["name"] == "camera2"]
    (tmp_path / "rig.json").write_text(json.dumps(rig))
    args = ["reconstruct", str(simulated), "--rig", str(tmp_path / "rig.json"), "--no-preview"]
    assert run([*args, "--out", str(tmp_path / "a")]) == 1
    assert "lacks camera 'camera1', it has camera2: use" in capsys.readouterr().err
    assert run([*args, "--view", "camera3", "--out", str(tmp_path / "a")]) == 2
    assert "it has camera1, camera2" in capsys.readouterr().err
    doc = answer([*args, "--view", "camera2", "--out", str(tmp_path / "a")], capsys)
    assert [v["camera"] for v in doc["views"]] == ["camera2"]
    doc = answer(["decode", str(simulated), "--view", "camera1", "--out", str(tmp_path / "d")], capsys)
    assert [v["camera"] for v in doc["views"]] == ["camera1"]
    both = ["--view", "camera1", "--view", "camera2"]
    doc = answer(["decode", str(simulated), *both, "--out", str(tmp_path / "e")], capsys)
    assert len(doc["views"]) == 2


def test_reconstruct_leaves_a_scan_on_the_true_plane(simulated: Path, scan: Path) -> None:
    """Truth from the twin: the points of the grids lie on its plane."""
    truth = json.loads((simulated / "truth" / "plane.json").read_text())
    back = store.read_scan(scan)
    cloud = export.read_ply(back.cloud)
    assert back.document["cloud"]["points"] == len(cloud) > 5000
    height = (cloud.xyz - truth["point"]) @ np.array(truth["normal"])
    assert 1.4826 * np.median(np.abs(height)) < 0.010
    assert back.document["capture"] == store.hash_capture(store.read_capture(simulated))
    assert back.document["rig"] == store.hash_rig(simulated / "truth" / "rig.json")
    assert back.document["settings"] == to_dict(load_settings(None, None))
    assert back.document["views"][0]["words"]
    assert (scan / "view.html").is_file()
    glb = (scan / "surface.glb").read_bytes()
    assert back.document["hash"].encode() in glb


def test_a_scan_keeps_its_pictures_and_the_instrument_that_took_it(simulated: Path, scan: Path) -> None:
    """And that URI opens the same instrument over the same scene, seen with other noise."""
    capture, back = store.read_capture(simulated), store.read_scan(scan)
    assert back.instrument == "sim://pair/plane?scale=0.04&seed=0&layout=diamond&noise=2"
    again = registry.open_station(back.instrument)
    with again:
        assert again.light is not None
        live = photograph(again.projector, again.cameras, again.light)
    for view, picture, frame in zip(store.view_inputs(capture), back.every_picture(), live, strict=True):
        assert (picture.pixel_format, picture.light) == (view.plan.pixel_format, "ring")
        assert view.color is not None
        np.testing.assert_array_equal(picture.frame, view.color)
        off = frame.astype(float) - picture.frame
        assert 0.1 < np.abs(off).mean() < 2.0  # other noise and nothing else
        assert abs(off.mean()) < 0.05


def test_the_background_serves_where_there_is_no_picture(simulated: Path) -> None:
    rig = store.read_rig(simulated / "truth" / "rig.json")
    views = [dataclasses.replace(v, color=None) for v in store.view_inputs(store.read_capture(simulated))]
    made = pipeline.scan(views, rig, surface=False)
    for view, picture in zip(views, made.pictures, strict=True):
        assert (picture.light, picture.pixel_format) == ("projector", view.plan.pixel_format)
        finest = [f.astype(float) for key, f in view.frames if key.set_index == len(view.plan.sets) - 1]
        np.testing.assert_allclose(picture.frame, np.mean(finest, axis=0), atol=0.51)


def test_a_scan_tells_its_times_once(scan: Path) -> None:
    doc = json.loads((scan / "scan.json").read_text())
    times = doc["times_s"]
    assert {"fuse", "mesh"} <= set(times)
    assert {c for c in ("camera1", "camera2") if any(c in stage for stage in times)} == {"camera1", "camera2"}
    assert all(t > 0 for t in times.values())
    assert "times_s" not in doc["figures"]


def test_all_points_grids_and_force(simulated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ["reconstruct", str(simulated), "--rig", str(simulated / "truth/rig.json"), "--out", str(tmp_path / "s")]
    doc = answer([*args, "--all-points", "--grids", "--no-preview"], capsys)
    back = store.read_scan(tmp_path / "s")
    assert doc["cloud"] == {"points": sum(int(g.valid.sum()) for g in back.grids), "kind": "all-points"}
    cloud = export.read_ply(back.cloud)
    expected = np.concatenate([g.xyz[g.valid] for g in back.grids])
    np.testing.assert_array_equal(cloud.xyz, expected)  # row by row, view by view
    assert tifffile.imread(tmp_path / "s/camera2/sigma.tif").shape == (146, 219)
    assert not (tmp_path / "s/view.html").exists()
    before = (tmp_path / "s/scan.json").read_text()
    assert run(args) == 1
    assert (tmp_path / "s/scan.json").read_text() == before
    assert run([*args, "--force", "--set", "denoise.min_modulation=4"]) == 0
    assert store.read_scan(tmp_path / "s").document["settings"]["denoise"]["min_modulation"] == 4


def test_decode(simulated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    doc = answer(["decode", str(simulated), "--out", str(tmp_path / "d")], capsys)
    assert [v["camera"] for v in doc["views"]] == ["camera1", "camera2"]
    phase = tifffile.imread(tmp_path / "d/camera1/phase_0.tif")
    reasons = cv2.imread(str(tmp_path / "d/camera1/reasons.png"), cv2.IMREAD_UNCHANGED)
    assert reasons.dtype == np.uint16
    np.testing.assert_array_equal(np.isfinite(phase), reasons == 0)
    assert doc["views"][0]["valid"] == int((reasons == 0).sum()) > 5000
    pictures = {p.name for p in (tmp_path / "d/camera1").glob("preview-*.png")}
    assert {
        "preview-phase_0.png",
        "preview-modulation.png",
        "preview-background.png",
        "preview-reasons.png",
    } == pictures


@needs_shared
def test_decode_of_a_bare_stack(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Truth by hand: the three-step formula on the stack's own samples."""
    path = SHARED / "stack-16bit" / "ex_stack.tif"
    doc = answer(
        ["decode", str(path), "--out", str(tmp_path / "d"), "--steps", "3", "--axis", "Z", "--time", "2"], capsys
    )
    assert doc["views"][0]["valid"] > 0.98 * 66 * 114
    I0, I1, I2 = tifffile.imread(path)[2].astype(float)
    expected = np.arctan2(np.sqrt(3) * (I1 - I2), 2 * I0 - I1 - I2)
    phase = tifffile.imread(tmp_path / "d/camera1/phase_0.tif")
    error = np.angle(np.exp(1j * (phase - expected)))
    assert np.nanmax(np.abs(error)) < 1e-3
    np.testing.assert_allclose(tifffile.imread(tmp_path / "d/camera1/background.tif"), (I0 + I1 + I2) / 3, rtol=1e-5)
    assert np.isnan(tifffile.imread(tmp_path / "d/camera1/u.tif")).all()


def three_steps(path: Path) -> None:
    """A stack of one set, wide enough that every pixel has neighbours."""
    x = np.tile(np.arange(90) * 2 * np.pi / 30, (60, 1))
    ideal = np.stack([110 + 70 * np.cos(x - 2 * np.pi * n / 3) for n in range(3)])
    steps = ideal + np.random.default_rng(0).normal(0, 1, ideal.shape)
    tifffile.imwrite(path, np.rint(steps).astype(np.uint8), photometric="minisblack")


def test_a_folder_with_one_stack_is_that_stack(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    three_steps(folder / "a.tif")
    (folder / "LICENSE.txt").write_text("free")
    tifffile.imwrite(folder / "photo.tif", np.zeros((60, 90), np.uint8), photometric="minisblack")  # a page is no stack
    doc = answer(["decode", str(folder), "--out", str(tmp_path / "d")], capsys)
    same = answer(["decode", str(folder / "a.tif"), "--out", str(tmp_path / "e")], capsys)
    assert doc["source"] == same["source"] == "a.tif"
    assert doc["capture"] == same["capture"]
    assert doc["views"] == same["views"]
    assert doc["views"][0]["valid"] > 5000
    three_steps(folder / "b.TIFF")
    assert run(["decode", str(folder), "--out", str(tmp_path / "f")]) == 1
    line = capsys.readouterr().err.splitlines()[-1]
    assert "no capture.json, and 2 TIFF stacks (a.tif, b.TIFF); needed one" in line
    (folder / "capture.json").write_text("{}")  # then it is a capture, whatever else lies there
    assert run(["decode", str(folder), "--out", str(tmp_path / "f")]) == 1
    assert "capture.json" in capsys.readouterr().err.splitlines()[-1]


@needs_shared
def test_the_folder_of_somebody_s_stack(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    doc = answer(["decode", str(SHARED / "stack-16bit"), "--out", str(tmp_path / "d")], capsys)
    assert doc["source"] == "ex_stack.tif"
    assert doc["views"][0]["valid"] > 0.98 * 66 * 114


def test_evaluate(scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    doc = answer(["evaluate", str(scan), "--fit", "plane", "--picture", str(tmp_path / "map.png")], capsys)
    assert doc["plane"]["spread"]["std_um"] < 10
    assert cv2.imread(str(tmp_path / "map.png")) is not None
    assert answer(["evaluate", str(scan / "cloud.ply"), "--fit", "plane"], capsys)["plane"] == doc["plane"]
    assert run(["evaluate", str(scan), "--fit", "plane"]) == 0
    assert "plane: " in capsys.readouterr().out
    assert run(["evaluate", str(scan), "--fit", "cube"]) == 2


@pytest.mark.parametrize("kind", ["stl", "obj", "pcd", "e57", "3mf", "ply", "glb"])
def test_export(scan: Path, tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / f"x.{kind}"
    doc = answer(["export", str(scan), "--to", kind, "--out", str(target)], capsys)
    assert target.stat().st_size > 1000
    assert {Path(f).name for f in doc["files"]} == {p.name for p in tmp_path.iterdir()}
    assert run(["export", str(scan), "--to", kind, "--out", str(target)]) == 1
    assert run(["export", str(scan), "--to", kind, "--out", str(target), "--force"]) == 0
    if kind == "stl":
        triangles = store.read_scan(scan).document["surface"]["triangles"]
        assert target.stat().st_size == 84 + 50 * triangles


def test_glb_comes_back(scan: Path) -> None:
    surface = export.read_glb(scan / "surface.glb")
    told = store.read_scan(scan).document["surface"]
    assert surface.n_faces == told["triangles"]
    assert len(np.unique(surface.vertices, axis=0)) == len(surface.vertices)
    cloud = export.read_ply(scan / "cloud.ply")
    assert abs(surface.vertices.mean(axis=0) - cloud.xyz.mean(axis=0)).max() < 2


def test_patterns(simulated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = simulated / "truth/rig.json"
    doc = answer(["patterns", str(rig), "--out", str(tmp_path / "p")], capsys)
    image = cv2.imread(str(tmp_path / "p/camera1/00.png"), cv2.IMREAD_UNCHANGED)
    assert image.shape == (1140, 912)
    assert doc["projector"]["layout"] == "diamond"
    assert len(doc["views"][0]["sets"]) == 3
    assert run(["patterns", str(rig), "--out", str(tmp_path / "p")]) == 1
    assert run(["patterns", str(rig), "--out", str(tmp_path / "q"), "--plan", "other"]) == 2


def test_import(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    x = np.arange(200) * 4.0
    (tmp_path / "in").mkdir()
    for i, (p, n) in enumerate((p, n) for p in (912.0, 100.0) for n in range(4)):
        row = 120 + 90 * np.cos(2 * np.pi * (20 + x) / p - 2 * np.pi * n / 4)
        cv2.imwrite(str(tmp_path / f"in/{i}.png"), np.tile(np.rint(row), (60, 1)).astype(np.uint8))
    args = ["import", str(tmp_path / "in"), "--periods", "912,100", "--out", str(tmp_path / "c")]
    doc = answer([*args, "--steps", "4"], capsys)
    assert doc["views"]["camera1"]["order"] == "right"
    capture = store.read_capture(tmp_path / "c")
    assert [s.cycles_per_pixel for s in capture.views[0].plan.sets] == [(1 / 912, 0.0), (0.01, 0.0)]  # type: ignore[union-attr]
    assert run([*args, "--steps", "4", "--force", "--step-order", "0,2,1,3"]) == 1
    assert "--step-order 0,1,2,3" in capsys.readouterr().err.replace("or --as-given", "")
    assert run([*args, "--steps", "4", "--force", "--step-order", "0,2,1,3", "--as-given"]) == 0
    assert "looks wrong" in capsys.readouterr().err
    assert run([*args, "--steps", "three"]) == 2


def test_devices_and_settings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    uris = [d["uri"] for d in answer(["devices"], capsys)["devices"]]
    assert "sim://paper/plane" in uris
    assert run(["settings", "--set", "phase.order_votes=7"]) == 0
    assert from_yaml(capsys.readouterr().out).phase.order_votes == 7
    (tmp_path / "s.yml").write_text("phase:\n  order_votes: 9\n")
    both = load_settings(tmp_path / "s.yml", ["phase.order_votes=3", "fuse.harmonise=false"])
    assert (both.phase.order_votes, both.fuse.harmonise) == (3, False)
    for bad in (
        "phase.order_votes",
        "order_votes=3",
        "phase.none=3",
        "none.x=1",
        "phase.order_votes=[",
        "phase.order_votes=x",
    ):
        with pytest.raises(UsageError):
            load_settings(None, [bad])
    with pytest.raises(UsageError):
        load_settings(tmp_path / "missing.yml", None)


def test_usage_errors_take_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for args in (
        ["recon"],
        ["reconstruct"],
        ["simulate", "plane"],
        ["simulate", "plane", "--scale", "x", "--out", "y"],
    ):
        assert run(args) == 2
        out, err = capsys.readouterr()
        assert out == ""
        assert len(err.splitlines()) == 1
        assert err.startswith("fringescope: ")
    assert run(["--version"]) == 0
    assert capsys.readouterr().out.startswith("fringescope 0.")
    assert run([]) == 2
    assert "reconstruct" in capsys.readouterr().out


def test_a_bug_is_one_line_unless_debugged(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def broken(*_: Any) -> Any:
        raise ZeroDivisionError("oh")

    monkeypatch.setattr("fringescope.cli.capturing.load_settings", broken)
    assert run(["settings"]) == 1
    err = capsys.readouterr().err
    assert "this is a bug" in err
    assert len(err.splitlines()) == 1
    assert run(["settings", "--debug"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_a_scene_may_be_a_whole_uri(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    uri = "sim://single/plane?scale=0.03&rays=1&seed=2&layout=grid&ring=0.9"
    assert run(["simulate", uri, "--out", str(tmp_path / "c")]) == 0
    told = json.loads((tmp_path / "c" / "capture.json").read_text())
    assert told["instrument"] == uri + "&noise=2"
    assert told["projector"]["layout"] == "grid"
    moved = world_of("sim://single/board?scale=0.03&pose=1&move=1,0,0#camera1")
    assert moved.uri == "sim://single/board?scale=0.03&pose=1&move=1,0,0&noise=2"
    there, here = (np.array(s.truth["poses.json"][0]["t"]) for s in (moved.scene, scene.make("board", pose=1)))
    assert np.allclose(there - here, [1, 0, 0])
    assert world_of("sim://single/plane?noise=0").uri == "sim://single/plane?noise=0"
    capsys.readouterr()
    assert run(["simulate", uri, "--preset", "pair", "--out", str(tmp_path / "e")]) == 2
    assert "--preset" in capsys.readouterr().err
    assert run(["simulate", "sim://single/plane?mov=1", "--out", str(tmp_path / "e")]) == 2
    assert "unknown option 'mov'" in capsys.readouterr().err
    assert not (tmp_path / "e").exists()


def test_progress_off_a_terminal_tells_only_slow_stages(capsys: pytest.CaptureFixture[str]) -> None:
    with Progress() as progress:
        assert list(progress.track([1, 2, 3], "quick", 3)) == [1, 2, 3]
        progress("slow", 0, 1)
        progress._begun["slow"] -= 2.0
        progress("slow", 1, 1)
        progress("long", 0, 9)
        progress._begun["long"] -= 11.0
        progress("long", 7, 9)
        progress("long", 8, 9)
    err = capsys.readouterr().err
    assert "slow: 2.0 s" in err
    assert "long: 7 of 9" in err
    assert "long: 8" not in err  # not again so soon
    assert "quick" not in err
    assert progress.times_s["slow"] > 2


def test_help_is_quick() -> None:
    """No stage, no kernel and no plotting is imported before a verb needs it."""
    slow = ("numba", "cv2", "matplotlib", "scipy", "tifffile", "pydantic")
    code = f"import sys, fringescope.cli; print([m for m in sys.modules if m in {slow}])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_leaves_nothing(tmp_path: Path, number: signal.Signals) -> None:
    code = "from fringescope.cli import main; main()"
    command = [sys.executable, "-c", code, "simulate", "tissue-domed", "--scale", "0.2", "--out", str(tmp_path / "c")]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=tmp_path)
    try:
        deadline = time.monotonic() + 120
        while not list(tmp_path.iterdir()) and time.monotonic() < deadline:
            time.sleep(0.05)
        process.send_signal(number)
        _, err = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == 130, err
    assert err.splitlines()[-1] == "fringescope: interrupted; nothing was written"
    assert list(tmp_path.iterdir()) == []


def test_the_demo_judges_by_the_distance_to_the_surface() -> None:
    """Points 10 um above balls and plate, at their silhouettes too, are 10 um off; three set aside fly."""
    world = make_world("sphere", "pair", 0.04, 0, "diamond", 0, "checkerboard")
    grids, along = [], []
    balls = world.scene.truth["sphere.json"]["spheres"]
    for n, camera in enumerate(("camera1", "camera2")):
        true = world.renderer.truth(camera).xyz
        normal = np.broadcast_to([0, 0, 1.0], true.shape).copy()
        for b in balls:
            on = np.linalg.norm(true - b["center"], axis=-1) < b["radius"] + 1e-6
            normal[on] = (true[on] - b["center"]) / b["radius"]
        away = true - geometry.centre(world.instrument.rig.camera(camera).pose)
        away /= np.linalg.norm(away, axis=-1, keepdims=True)
        along.append(np.abs(0.01 / (away * normal).sum(-1)))
        xyz = true + 0.01 * normal
        xyz[0, 0, 2] += 0.5
        ok = np.isfinite(true).all(-1)
        reasons = np.where(ok, 0, 1).astype(np.uint16)
        grids.append(Grid(n, camera, xyz.astype(np.float32), np.ones(ok.shape, np.float32), reasons))
    assert max(a.max() for a in along) > 0.1  # what it comes to along the rays
    empty = Cloud(*(np.zeros((0, 3), t) for t in (np.float32, np.float32, np.uint8)), *(np.zeros(0, np.float32),) * 2)
    where, error = errors(Scan(tuple(grids), empty, None, (), {}), world)
    assert len(where) == len(error) == sum(int(g.valid.sum()) for g in grids)
    flying = np.abs(error) > 200
    assert flying.sum() == 2
    np.testing.assert_allclose(error[flying], 510, atol=1)
    np.testing.assert_allclose(error[~flying], 10, atol=0.1)


def test_demo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = [
        "demo",
        "--headless",
        "--out",
        str(tmp_path / "d"),
        "--scale",
        "0.04",
        "--preset",
        "pair",
        "--scene",
        "sphere",
    ]
    doc = answer(args, capsys)
    for name in ("capture/capture.json", "capture/truth/rig.json", "scan/scan.json", "scan/surface.glb", "demo.json"):
        assert (tmp_path / "d" / name).is_file()
    for name in ("error_map.png", "surface.png", "relief.png"):
        picture = cv2.imread(str(tmp_path / "d" / name))
        assert picture.std() > 5
    assert doc["error"]["std_um"] < 30
    assert 0 <= doc["error"]["flying_ppm"] < 2000
    assert doc["error"]["rms_um"] < 60
    assert run([*args, "--force"]) == 0
    told = capsys.readouterr().out
    assert "against the true surface, along its normal: std " in told
    assert "of a million points fly, farther than 0.2 mm from it" in told
    assert run(args) == 1
    assert "already holds a demo" in capsys.readouterr().err
