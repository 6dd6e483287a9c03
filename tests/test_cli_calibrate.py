"""`fringescope calibrate` from folders to a rig and its report: what fails, what is left out by name, what repeats."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from fringescope import calibrate, cli, pipeline, report, store
from fringescope.settings import Settings
from fringescope.types import Board
from tests.board_pictures import Scene, take

THIN = ["--set", "board.max_samples=300"]


@pytest.fixture
def session(shared, tmp_path):
    """Makes a session of some of the rendered poses, so that it can be spoilt."""

    def make(*poses: int, cameras: int = 3) -> Path:
        source, folder = shared / "data" / "rendered-small" / "calibration", tmp_path / "session"
        folder.mkdir()
        shutil.copy(source / "board.json", folder)
        for pose in poses:
            name = f"pose{pose:02d}"
            shutil.copytree(source / name, folder / name)
            if cameras < 3:
                path = folder / name / "capture.json"
                doc = json.loads(path.read_text())
                doc["views"] = doc["views"][:cameras]
                path.write_text(json.dumps(doc))
        return folder

    return make


def failed(args, capsys) -> str:
    """The one line on stderr of a command that ends with status 1."""
    assert cli.run(["calibrate", *map(str, args)]) == 1
    lines = [x for x in capsys.readouterr().err.strip().splitlines() if not x.endswith(" s")]
    assert len(lines) == 1, lines
    return lines[0]


def test_a_failed_calibration_leaves_a_report_and_no_rig(session, tmp_path, capsys) -> None:
    folder, rig = session(0, cameras=1), tmp_path / "rig.json"
    assert "pose" in failed([folder, "--out", rig, *THIN], capsys)
    assert not rig.exists()
    page = (tmp_path / "rig.html").read_text()
    assert "No calibration" in page
    assert "pose00" in page and "camera1" in page  # noqa: PT018


def test_a_rig_that_is_there_is_kept_before_any_work(session, tmp_path, capsys) -> None:
    rig = tmp_path / "rig.json"
    rig.write_text("mine")
    assert "--force" in failed([session(0, cameras=1), "--out", rig], capsys)
    assert rig.read_text() == "mine"
    assert not (tmp_path / "rig.html").exists()


def test_pictures_that_cannot_be_read_are_left_out_by_name(session, tmp_path, capsys) -> None:
    folder, rig = session(0, 1, 2, 3, cameras=2), tmp_path / "rig.json"
    frame = folder / "pose01" / "camera2" / "05.png"
    frame.write_bytes(frame.read_bytes()[:5000])
    assert cli.run(["calibrate", str(folder), "--out", str(rig), "--json", *THIN]) == 0
    told = json.loads(capsys.readouterr().out)
    assert len(told["not_used"]) == 1
    assert told["not_used"][0].startswith("pose01/camera2: ")
    assert "05.png" in told["not_used"][0]
    page = (tmp_path / "rig.html").read_text()
    assert "05.png" in page
    # the rig's file carries what was seen: the solve repeats without the pictures
    shutil.rmtree(folder)
    again = tmp_path / "again.json"
    assert cli.run(["calibrate", str(rig), "--out", str(again), "--json"]) == 0
    a, b = store.read_rig(rig), store.read_rig(again)
    for one, two in zip(a.devices, b.devices, strict=True):
        np.testing.assert_allclose(two.lens.K, one.lens.K, rtol=1e-5)
        np.testing.assert_allclose(two.pose.t, one.pose.t, atol=2e-3)
    assert a.volume is not None
    promised = a.extra["calibration"]["predicted_views_um"]
    assert set(promised) == {"camera1 - camera2"}
    assert 0.05 < promised["camera1 - camera2"] < 5
    board, sightings = store.read_observations(rig)
    assert board.inner_corners == (11, 8)
    assert {s.name for s in sightings} == {f"pose{p:02d}/camera{c}" for p in range(4) for c in (1, 2)} - {
        "pose01/camera2"
    }


def test_frames_of_another_size_name_both_poses(session, tmp_path, capsys) -> None:
    folder = session(0, 1, cameras=1)
    path = folder / "pose01" / "capture.json"
    doc = json.loads(path.read_text())
    doc["projector"]["width"] = 1024
    path.write_text(json.dumps(doc))
    line = failed([folder, "--out", tmp_path / "rig.json"], capsys)
    assert "1024 x 1140" in line and "pose00" in line  # noqa: PT018
    assert "1024 x 1140" in (tmp_path / "rig.html").read_text()


@pytest.mark.parametrize(
    ("spoil", "word"),
    [
        (lambda f: (f / "board.json").unlink(), "board.json"),
        (lambda f: (f / "board.json").write_text('{"pattern": "dots", "square_mm": 5.0}'), "checkerboard"),
        (lambda f: (f / "board.json").write_text('{"pattern": "checkerboard", "square_mm": 5.0}'), "inner_corners"),
        (lambda f: (f / "board.json").write_text(
            '{"pattern": "checkerboard", "inner_corners": [11, 8], "square_mm": -5.0}'), "positive"),
        (lambda f: shutil.rmtree(f / "pose00"), "pose00"),
    ],
)  # fmt: skip
def test_a_session_that_is_none(session, tmp_path, capsys, spoil, word) -> None:
    folder = session(0, cameras=1)
    spoil(folder)
    assert word in failed([folder, "--out", tmp_path / "rig.json"], capsys)
    assert not (tmp_path / "rig.json").exists()


def test_observations_that_are_damaged(tmp_path, capsys) -> None:
    rig = tmp_path / "plain.json"
    rig.write_text('{"format": "fringescope-rig", "version": 1}')
    assert "no observations" in failed([rig, "--out", tmp_path / "new.json"], capsys)
    board = {"pattern": "checkerboard", "inner_corners": [3, 4], "square_mm": 5.0}
    for broken in ({}, {"corner": {"dtype": "<i4", "shape": [2, 2], "deflate": "eA=="}}, 7):
        rig.write_text(json.dumps({"board": board, "observations": [{"pose": "a", "camera": "b", "corner": broken}]}))
        assert "calibrate anew" in failed([rig, "--out", tmp_path / "new.json"], capsys)


def test_report_pictures_that_were_reduced_show_corners_where_they_are() -> None:
    """A yellow ring stands around the same board corner in the whole picture and in one of half the size."""
    one = take(Scene())
    h, w = one.image.shape
    board = Board((one.inner[0] + 1, one.inner[1] + 1), one.square)
    sighting = calibrate.see(one.decoded, one.image.astype(np.float32), one.plan, board, "pose")
    half = one.image.reshape(h // 2, 2, w // 2, 2).mean(axis=(1, 3))
    for image in (one.image, half):
        drawn = report.sighting_picture(image, sighting)
        scale = drawn.shape[1] / w
        yellow = np.argwhere((drawn[..., 0] > 200) & (drawn[..., 1] > 150) & (drawn[..., 2] < 80))[:, ::-1]
        places = (sighting.corner_px + 0.5) * scale - 0.5
        nearest = np.linalg.norm(yellow[:, None] - places[None], axis=2).min(axis=0)
        gap = scale * np.min(np.linalg.norm(sighting.corner_px[0] - sighting.corner_px[1:], axis=1))
        assert nearest.max() < 0.4 * gap
        assert np.linalg.norm(yellow[:, None] - places[None], axis=2).min(axis=1).mean() < 0.4 * gap


def test_patterns_for_a_board_need_no_rig(tmp_path, capsys) -> None:
    out = tmp_path / "patterns"
    line = ["patterns", "--plan", "calibration", "--projector", "60x80", "--layout", "diamond", "--out", str(out)]
    assert cli.run([*line, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    directions = [s["cycles_per_pixel"] for s in told["views"][0]["sets"]]
    assert any(g[1] == 0 for g in directions)
    assert any(g[0] == 0 for g in directions)
    image = cv2.imread(str(next(out.rglob("00.png"))), cv2.IMREAD_UNCHANGED)
    assert image.shape == (80, 60)
    for wrong in (["--plan", "paper"], ["--plan", "calibration"], [*line[1:5], "--layout", "hexagon"]):
        assert cli.run(["patterns", *wrong, "--out", str(tmp_path / "no")]) == 2
    rig = tmp_path / "rig.json"
    assert cli.run(["patterns", str(rig), *line[1:]]) == 2
    assert "leave out" in capsys.readouterr().err


def test_bands_of_rows_decode_to_the_same_as_the_whole(shared, monkeypatch) -> None:
    capture = store.read_capture(shared / "data" / "rendered-small" / "calibration" / "pose03")
    view = store.view_inputs(capture)[1]
    whole, mean = pipeline.decode_bands(view, Settings())
    monkeypatch.setattr(pipeline, "BAND", 684 * 70)
    banded, same = pipeline.decode_bands(view, Settings())
    np.testing.assert_array_equal(banded.reasons, whole.reasons)
    np.testing.assert_array_equal(same, mean)
    for a, b in zip(banded.directions, whole.directions, strict=True):
        np.testing.assert_array_equal(a.phase, b.phase)
        np.testing.assert_allclose(a.sigma, b.sigma, rtol=1e-6)
    assert np.isfinite(whole.directions[0].phase).sum() > 50_000
    spooled, same = pipeline.decode_bands(replace(view, frames=store.spooled(view.frames, 1 << 40)), Settings())
    np.testing.assert_array_equal(spooled.directions[0].phase, banded.directions[0].phase)
    np.testing.assert_array_equal(same, mean)


@pytest.mark.verify
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory is read from /proc")
def test_pictures_of_20_megapixels_stay_below_3_gb(shared, tmp_path, record_property) -> None:
    source = shared / "data" / "rendered-small" / "calibration"
    folder = tmp_path / "session"
    doc = json.loads((source / "pose03" / "capture.json").read_text())
    doc["views"] = doc["views"][:1]
    doc["views"][0] |= {"pixel_format": "Mono16"}
    doc["views"][0].pop("color", None)
    (folder / "pose03" / "camera1").mkdir(parents=True)
    shutil.copy(source / "board.json", folder)
    (folder / "pose03" / "capture.json").write_text(json.dumps(doc))
    for one in doc["views"][0]["sets"]:
        for name in one["frames"]:
            raw = cv2.imread(str(source / "pose03" / name), cv2.IMREAD_UNCHANGED)
            grey = cv2.demosaicing(raw, cv2.COLOR_BayerBG2GRAY).astype(np.uint16) * 257
            large = cv2.resize(grey, (5472, 3648), interpolation=cv2.INTER_CUBIC)
            cv2.imwrite(str(folder / "pose03" / name), large, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    program = (
        "import re, sys; from fringescope import cli; cli.run(sys.argv[1:]);"
        "print(re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1])"  # not what the parent's fork took
    )
    command = [sys.executable, "-c", program, "calibrate", str(folder), "--out", str(tmp_path / "rig.json")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert "1 usable pose" in done.stderr  # it found the board, and asks for more
    record_property("peak, GB", round(int(done.stdout.splitlines()[-1]) / 1e6, 2))
    assert int(done.stdout.splitlines()[-1]) < 3e6  # kB


def test_what_is_wrong_is_named_once_and_a_mirrored_camera_with_its_reason(session, tmp_path, capsys) -> None:
    folder, rig = session(0, 1, 2, 3, cameras=2), tmp_path / "rig.json"
    for pose in folder.glob("pose*"):
        path = pose / "capture.json"
        doc = json.loads(path.read_text())
        for v in doc["views"]:
            v["pixel_format"] = "Mono8"
            v.pop("color", None)
        path.write_text(json.dumps(doc))
        for p in pose.glob("camera*/*.png"):
            grey = cv2.demosaicing(cv2.imread(str(p), cv2.IMREAD_UNCHANGED), cv2.COLOR_BayerBG2GRAY)
            cv2.imwrite(str(p), cv2.flip(grey, 1) if p.parent.name == "camera2" else grey)
    line = failed([folder, "--out", rig, *THIN], capsys)  # one line
    assert "camera2 has 0 usable poses" in line
    assert "camera2, 4 of 4 pictures: the projector's coordinates run mirrored in this picture" in line
    assert "pose00/camera2" not in line
    assert "camera1," not in line
    page = (tmp_path / "rig.html").read_text()
    assert "camera2, 4 of 4 pictures" in page
    assert "camera2: pose0" not in page


def test_settings_that_mean_nothing_are_refused_before_pictures_are_read(tmp_path, capsys) -> None:
    (tmp_path / "session").mkdir()  # nothing in it: no picture is asked for
    for wrong in ("lens=foo", "projector_lens=k9", "projector=stars", "board_shape=round"):
        line = ["calibrate", str(tmp_path / "session"), "--out", str(tmp_path / "rig.json")]
        assert cli.run([*line, "--set", f"calibrate.{wrong}"]) == 2
        assert wrong.split("=")[1] in capsys.readouterr().err
    assert not (tmp_path / "rig.html").exists()


@pytest.mark.parametrize("spoil", ["no board", "no JSON", "another pattern", "no poses"])
def test_a_session_that_cannot_be_read_gets_its_report(session, tmp_path, capsys, spoil) -> None:
    folder = session(0, cameras=1)
    if spoil == "no poses":
        shutil.rmtree(folder / "pose00")
    elif spoil == "no board":
        (folder / "board.json").unlink()
    else:
        (folder / "board.json").write_text('{"pattern": "dots"}' if spoil == "another pattern" else '{"pattern": "ch')
    page = tmp_path / "why.html"
    line = failed([folder, "--out", tmp_path / "rig.json", "--report", page], capsys)
    assert line.endswith(f"; see {page}")
    text = page.read_text()
    assert "No calibration" in text
    assert {"no poses": "no captures"}.get(spoil, "board.json") in text
    assert not (tmp_path / "rig.json").exists()


def test_the_page_of_a_session_called_calibration_is_called_by_the_folder_above(session, tmp_path, capsys) -> None:
    folder = session(0, cameras=1).rename(tmp_path / "calibration")
    failed([folder, "--out", tmp_path / "rig.json", *THIN], capsys)
    assert f"<h1>Calibration of {tmp_path.name}</h1>" in (tmp_path / "rig.html").read_text()


def test_help_says_that_the_rig_is_a_file(capsys) -> None:
    assert cli.run(["calibrate", "--help"]) == 0
    shown = capsys.readouterr().out
    assert "rig.json to write" in shown
    assert "empty folder" not in shown


def test_a_missing_frame_costs_its_picture_and_a_pose_without_a_capture_is_named(session, tmp_path, capsys) -> None:
    folder, rig = session(0, 1, 2, 3, 4, cameras=2), tmp_path / "rig.json"
    (folder / "pose01" / "camera2" / "05.png").unlink()
    (folder / "pose04" / "capture.json").unlink()
    colour = folder / "pose00" / "camera1" / "color.png"
    colour.write_bytes(colour.read_bytes()[:3000])  # nothing here needs it
    (folder / "truth").mkdir()  # no pose
    assert cli.run(["calibrate", str(folder), "--out", str(rig), "--json", *THIN]) == 0
    told = sorted(json.loads(capsys.readouterr().out)["not_used"])
    assert len(told) == 2
    assert told[0].startswith("pose01/camera2: ")
    assert "05.png: frame is missing" in told[0]
    assert told[1].startswith("pose04: no capture.json in it")
    names = {s.name for s in store.read_observations(rig)[1]}
    assert names == {f"pose{p:02d}/camera{c}" for p in range(4) for c in (1, 2)} - {"pose01/camera2"}
    page = (tmp_path / "rig.html").read_text()
    assert "05.png: frame is missing" in page
    assert "no capture.json in it" in page
