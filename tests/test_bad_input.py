"""Bad input: one clear line on stderr, status 1 or 2, no traceback, nothing half written, nothing overwritten."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from fringescope import store
from fringescope.cli import run
from fringescope.store.files import check_name
from fringescope.types import FringeSet, Layout, PixelFormat, ViewInput, ViewPlan

W, H = 64, 48
PLANE = (100, 80)


def view_input(
    fmt: PixelFormat = PixelFormat.MONO8,
    periods: tuple[float, ...] = (110.0, 16.0),
    dark: bool = False,
    rows: int = H,
) -> ViewInput:
    """Fringes that a camera sees when it looks straight at the projector's plane."""
    sets = tuple(FringeSet((1 / p, 0.0), 4) for p in periods)
    plan = ViewPlan("camera1", fmt, sets, PLANE)
    x = np.tile(10 + np.arange(W) * 1.2, (rows, 1))
    frames = []
    for k in plan.keys:
        p = periods[k.set_index]
        ideal = 0.0 * x if dark else 0.5 + 0.4 * np.cos(2 * np.pi * (x / p - k.number / 4))
        noise = np.random.default_rng(k.number).normal(0, 0.005, x.shape)
        frames.append(
            (k, np.clip(np.rint(fmt.max_value * (ideal + (0 if dark else noise))), 0, fmt.max_value).astype(fmt.dtype))
        )
    return ViewInput(plan, frames)


def rig_document() -> dict[str, Any]:
    """A projector at the origin and a camera 100 mm beside it, both looking at (0, 0, 500)."""
    a = np.arctan2(100, 500)
    R = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    c = np.array([100.0, 0, 0])
    lens = {"K": [[500.0, 0, W / 2], [0, 500.0, H / 2], [0, 0, 1]], "distortion": [0.0] * 5}
    camera = {"name": "camera1", "width": W, "height": H, **lens, "R": R.tolist(), "t": (-R @ c).tolist()}
    projector = {
        "width": PLANE[0],
        "height": PLANE[1],
        "layout": "grid",
        **lens,
        "R": np.eye(3).tolist(),
        "t": [0.0, 0, 0],
    }
    return {"format": "fringescope-rig", "version": 1, "units": "mm", "projector": projector, "cameras": [camera]}


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    store.write_capture(tmp_path / "capture", *PLANE, Layout.GRID, [view_input()])
    return tmp_path / "capture"


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    (tmp_path / "rig.json").write_text(json.dumps(rig_document()))
    return tmp_path / "rig.json"


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture
def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command that must fail; returns its line after seeing that it left everything as it was."""

    def check(*args: object, status: int = 1) -> str:
        before = tree(tmp_path)
        got = run([str(a) for a in args])
        out, err = capsys.readouterr()
        lines = [x for x in err.splitlines() if not re.fullmatch(r".+: \d+\.\d s", x)]  # slow stages
        assert got == status, err
        assert out == ""
        assert len(lines) == 1, err
        assert lines[0].startswith("fringescope: ")
        assert "Traceback" not in err
        assert "this is a bug" not in err
        assert tree(tmp_path) == before
        assert not list(tmp_path.rglob(".*"))
        return lines[0]

    return check


def test_the_good_capture_is_accepted(capture: Path, rig: Path, tmp_path: Path) -> None:
    """Otherwise the refusals below would prove nothing."""
    assert run(["decode", str(capture), "--out", str(tmp_path / "d")]) == 0
    store.check_rig(store.read_capture(capture), store.read_rig(rig))


# ------------------------------------------------------------------------------------------------------------- frames


def damage_truncate(p: Path) -> None:
    p.write_bytes(p.read_bytes()[:-40])


def damage_flip(p: Path) -> None:
    data = bytearray(p.read_bytes())
    data[len(data) // 2] ^= 0xFF
    p.write_bytes(bytes(data))


def damage_resize(p: Path) -> None:
    cv2.imwrite(str(p), np.zeros((H, W + 1), np.uint8))


def damage_16(p: Path) -> None:
    cv2.imwrite(str(p), np.zeros((H, W), np.uint16))


def damage_colour(p: Path) -> None:
    cv2.imwrite(str(p), np.random.default_rng(0).integers(0, 255, (H, W, 3)).astype(np.uint8))


def damage_alpha(p: Path) -> None:
    cv2.imwrite(str(p), np.zeros((H, W, 4), np.uint8))


def damage_jpeg(p: Path) -> None:
    p.write_bytes(cv2.imencode(".jpg", np.zeros((H, W), np.uint8))[1].tobytes())


def damage_folder(p: Path) -> None:
    p.unlink()
    p.mkdir()


@pytest.mark.parametrize("verb", ["decode", "reconstruct"])
@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda p: p.unlink(), "missing"),
        (lambda p: p.write_bytes(b""), "PNG or TIFF"),
        (lambda p: p.write_bytes(b"hello, this is no picture at all"), "not an image"),
        (damage_truncate, "truncated PNG"),
        (damage_flip, "damaged PNG|truncated PNG"),
        (damage_resize, "65 x 48 pixels; the view's other frames have 64 x 48"),
        (damage_16, "16-bit file; Mono8 needs 8 bits"),
        (damage_colour, "colour picture"),
        (damage_alpha, "4 channels"),
        (damage_jpeg, "JPEG"),
        (damage_folder, "[Ii]s a (folder|directory)"),
    ],
)
def test_frames(
    capture: Path, rig: Path, tmp_path: Path, refused: Callable[..., str], damage: Any, says: str, verb: str
) -> None:
    damage(capture / "camera1" / "05.png")
    args = ["--rig", rig] if verb == "reconstruct" else []
    line = refused(verb, capture, *args, "--out", tmp_path / "out")
    assert re.search(says, line), line
    assert "05.png" in line


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="named pipes in folders are a POSIX matter")
@pytest.mark.parametrize("what", ["pipe", "device"])
@pytest.mark.parametrize("name", ["05.png", "color.png"])
def test_a_pipe_or_a_device_is_no_frame(
    capture: Path, rig: Path, tmp_path: Path, refused: Callable[..., str], what: str, name: str
) -> None:
    """Opened, a pipe without a writer waits for ever: the run stands aside, so that it can be stopped."""
    path = capture / "camera1" / name
    path.unlink(missing_ok=True)
    if what == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    change(capture, lambda d: d["views"][0].update(color="camera1/color.png") if name == "color.png" else None)
    told = []
    for verb, more in (("decode", []), ("reconstruct", ["--rig", rig])):
        thread = threading.Thread(
            target=lambda verb=verb, more=more: told.append(refused(verb, capture, *more, "--out", tmp_path / "out")),
            daemon=True,
        )
        thread.start()
        thread.join(30)
        assert not thread.is_alive(), f"{verb} hangs"
    assert len(told) == 2
    assert all(f"{name}: is a pipe or a device; needed a PNG or TIFF frame" in line for line in told)


def test_twelve_bits(tmp_path: Path, refused: Callable[..., str]) -> None:
    store.write_capture(tmp_path / "c", *PLANE, Layout.GRID, [view_input(PixelFormat.MONO12)])
    path = tmp_path / "c/camera1/03.png"
    raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(path), raw << 4)
    line = refused("decode", tmp_path / "c", "--out", tmp_path / "out")
    assert "03.png" in line
    assert "left-aligned" in line
    cv2.imwrite(str(path), raw + 4000)
    assert "Mono12 goes to 4095" in refused("decode", tmp_path / "c", "--out", tmp_path / "out")
    cv2.imwrite(str(path), (raw >> 4).astype(np.uint8))
    assert "8-bit file; Mono12 needs 16 bits" in refused("decode", tmp_path / "c", "--out", tmp_path / "out")


def test_tiffs(capture: Path, tmp_path: Path, refused: Callable[..., str]) -> None:
    stack = np.zeros((3, H, W), np.uint8)
    tifffile.imwrite(capture / "s.tif", stack, photometric="minisblack")
    change(capture, lambda d: first_set(d)["frames"].__setitem__(0, "s.tif#3"))
    assert "3 pages" in refused("decode", capture, "--out", tmp_path / "out")
    change(capture, lambda d: first_set(d)["frames"].__setitem__(0, "s.tif"))
    assert "say which" in refused("decode", capture, "--out", tmp_path / "out")
    change(capture, lambda d: first_set(d)["frames"].__setitem__(0, "s.tif#0"))
    (capture / "s.tif").write_bytes((capture / "s.tif").read_bytes()[:5000])
    assert "s.tif" in refused("decode", capture, "--out", tmp_path / "out")
    tifffile.imwrite(capture / "s.tif", stack.astype(np.float32), photometric="minisblack")
    assert "float32" in refused("decode", capture, "--out", tmp_path / "out")


def test_an_empty_view(tmp_path: Path, rig: Path, refused: Callable[..., str]) -> None:
    store.write_capture(tmp_path / "c", *PLANE, Layout.GRID, [view_input(dark=True)])
    assert "dark" in refused("decode", tmp_path / "c", "--out", tmp_path / "out")
    refused("reconstruct", tmp_path / "c", "--rig", rig, "--out", tmp_path / "out")


def test_frames_of_one_row(tmp_path: Path, refused: Callable[..., str]) -> None:
    store.write_capture(tmp_path / "c", *PLANE, Layout.GRID, [view_input(rows=1)])
    assert f"frames of {W} x 1 pixels" in refused("decode", tmp_path / "c", "--out", tmp_path / "out")


def test_sets_that_cannot_be_unwrapped(tmp_path: Path, refused: Callable[..., str]) -> None:
    store.write_capture(tmp_path / "c", *PLANE, Layout.GRID, [view_input(periods=(16.0,))])
    line = refused("decode", tmp_path / "c", "--out", tmp_path / "out")
    assert re.search("period|unambiguous|span|set", line), line


# ---------------------------------------------------------------------------------------------------------- documents


def change(capture: Path, edit: Callable[[dict[str, Any]], Any]) -> None:
    doc = json.loads((capture / "capture.json").read_text())
    edit(doc)
    (capture / "capture.json").write_text(json.dumps(doc))


def first_set(doc: dict[str, Any]) -> Any:
    return doc["views"][0]["sets"][0]


@pytest.mark.parametrize(
    ("edit", "says"),
    [
        (lambda d: first_set(d).update(steps=2, frames=first_set(d)["frames"][:2]), "phase shifting needs"),
        (lambda d: first_set(d).update(steps=5), '"steps" is 5 but it names 4'),
        (lambda d: first_set(d)["frames"].__setitem__(1, first_set(d)["frames"][0]), "named twice"),
        (lambda d: first_set(d)["frames"].__setitem__(0, "../secret.png"), "leaves the capture"),
        (lambda d: first_set(d)["frames"].__setitem__(0, "/etc/passwd"), "absolute"),
        (lambda d: first_set(d)["frames"].__setitem__(0, "C:/x.png"), "absolute"),
        (lambda d: first_set(d)["frames"].__setitem__(0, "camera1\\00.png"), "forward slashes"),
        (lambda d: first_set(d)["frames"].__setitem__(0, "a\u0000b.png"), "control"),
        (lambda d: first_set(d)["frames"].__setitem__(0, "x" * 600 + ".png"), "too long"),
        (lambda d: first_set(d).update(cycles_per_pixel=[0, 0]), "more than 1e-09 cycles"),
        (lambda d: first_set(d).update(cycles_per_pixel=[0, 1e-300]), "more than 1e-09 cycles"),
        (lambda d: first_set(d).update(cycles_per_pixel=[0, 2]), "more than one projector-plane unit"),
        (lambda d: first_set(d).update(cycles_per_pixel=[0.1]), "two numbers"),
        (lambda d: first_set(d).update(gray="u"), "either"),
        (lambda d: d["views"][0].update(pixel_format="Mono9"), "needed one of"),
        (lambda d: d["views"][0].update(camera="../x"), "names a folder"),
        (lambda d: d["views"][0].update(sets=[]), "no sets"),
        (lambda d: d["views"].append(d["views"][0]), "not unique"),
        (lambda d: d.update(views=[]), "views"),
        (lambda d: d.update(version=2), "higher"),
        (lambda d: d.update(format="x"), "format"),
        (lambda d: d["projector"].update(layout="hexagon"), "diamond"),
        (lambda d: d["projector"].pop("width"), "projector.width is missing"),
        (lambda d: d["projector"].update(width="912"), 'projector.width: needed a whole number; came "912"'),
        (lambda d: d["projector"].update(width=0), "needed at least 1; came 0"),
        (lambda d: d.update(views={}), "needed a list"),
        (lambda d: d.update(projector=[]), "needed an object {...}"),
        (lambda d: d["views"][0].update(noise={"a": -1, "b": 0}), "noise"),
    ],
)
def test_capture_documents(
    capture: Path, tmp_path: Path, refused: Callable[..., str], edit: Callable[[dict[str, Any]], Any], says: str
) -> None:
    change(capture, edit)
    line = refused("decode", capture, "--out", tmp_path / "out")
    assert says in line
    assert "capture" in line


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "null", '"x"', "{}", "\x00", '{"format": "fringescope-capture", "version": 1}', "[" * 100000],
)
def test_files_that_are_no_documents(
    capture: Path, rig: Path, tmp_path: Path, refused: Callable[..., str], text: str
) -> None:
    (capture / "capture.json").write_text(text)
    assert "capture.json" in refused("decode", capture, "--out", tmp_path / "out")
    rig.write_text(text.replace("capture", "rig"))
    assert "rig.json" in refused("patterns", rig, "--out", tmp_path / "out")


def test_missing_things(capture: Path, rig: Path, tmp_path: Path, refused: Callable[..., str]) -> None:
    nowhere = tmp_path / "nowhere"
    refused("decode", nowhere, "--out", tmp_path / "out")
    refused("decode", tmp_path, "--out", tmp_path / "out")
    refused("reconstruct", nowhere, "--rig", rig, "--out", tmp_path / "out")
    refused("reconstruct", capture, "--rig", nowhere, "--out", tmp_path / "out")
    refused("reconstruct", capture, "--rig", tmp_path, "--out", tmp_path / "out")
    refused("evaluate", nowhere, "--fit", "plane")
    refused("evaluate", capture / "capture.json", "--fit", "plane")
    refused("evaluate", capture, "--fit", "plane")
    refused("export", capture, "--to", "stl", "--out", tmp_path / "x.stl")
    refused("patterns", nowhere, "--out", tmp_path / "out")
    refused("import", nowhere, "--steps", "4", "--periods", "36", "--out", tmp_path / "out")
    refused("decode", capture, "--out", tmp_path / "out", "--settings", nowhere, status=2)
    refused("decode", capture, "--out", tmp_path / "out", "--set", "phase.order_votes=many", status=2)
    refused("decode", capture, "--out", tmp_path / "out", "--steps", "3", status=2)
    (tmp_path / "x.tif").write_bytes(b"II*\x00 broken")
    refused("decode", tmp_path / "x.tif", "--out", tmp_path / "out")


nan, inf = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("edit", "says"),
    [
        (lambda d: d["cameras"][0].update(name="other"), "lacks camera 'camera1'"),
        (lambda d: d["cameras"][0].update(width=65), "65 x 48"),
        (lambda d: d["projector"].update(width=99), "99 x 80"),
        (lambda d: d["projector"].update(layout="diamond"), "diamond"),
        (lambda d: d["cameras"][0]["K"][0].__setitem__(0, nan), "NaN"),
        (lambda d: d["cameras"][0]["K"][0].__setitem__(0, inf), "NaN or infinity"),
        (lambda d: d["cameras"][0]["K"][0].__setitem__(0, 0), "positive"),
        (lambda d: d["projector"].update(K=[[0, 0, 0]] * 3), "positive"),
        (lambda d: d["projector"].update(K=[[1, 2]]), "shape"),
        (lambda d: d["cameras"][0].update(R=[[1, 0, 0], [0, 1, 0], [0, 0, -1]]), "rotation"),
        (lambda d: d["cameras"][0].update(t=[0, nan, 0]), "NaN"),
        (lambda d: d["cameras"][0].update(distortion=[0, 0, 0, 0]), "shape"),
        (lambda d: d["cameras"][0].update(distortion=[1e6] * 5), "camera 'camera1': distortion"),
        (lambda d: d["projector"].update(distortion=[1e6] * 5), "projector: distortion"),
        (lambda d: d["cameras"][0].update(distortion=[1e6, 0, 0, 0, 0]), "stretches more than 3 times at ("),
        (lambda d: d["projector"].update(distortion=[0, 0, 0, 0, 1e6]), "stretches more than 3 times at ("),
        (lambda d: d["cameras"][0].update(distortion=[0, 0, 0, 1e6, 0]), "folds at ("),
        (lambda d: d["projector"].update(distortion=[-1e6, 0, 0, 0, 0]), "folds at ("),
        (lambda d: d.update(cameras=[]), "no cameras"),
        (lambda d: d.update(units="m"), "mm"),
        (lambda d: d.update(version=7), "higher"),
        (
            lambda d: d.update(volume={"center": [0, 0, 0], "axes": np.eye(3).tolist(), "half_size": [1, 1, 0]}),
            "positive",
        ),
    ],
)
def test_rigs(
    capture: Path,
    rig: Path,
    tmp_path: Path,
    refused: Callable[..., str],
    edit: Callable[[dict[str, Any]], Any],
    says: str,
) -> None:
    doc = rig_document()
    edit(doc)
    rig.write_text(json.dumps(doc))
    assert says in refused("reconstruct", capture, "--rig", rig, "--out", tmp_path / "out")


@pytest.mark.parametrize("name", ["scan.json", "cloud.ply", "surface.glb", "Preview.GLB", "view.html", "capture.json",
                                  "decoded.json", "plan.json"])  # fmt: skip
def test_a_camera_named_like_a_file_of_ours(
    capture: Path, rig: Path, tmp_path: Path, refused: Callable[..., str], name: str
) -> None:
    says = f'"{name}": is the name of a file that we write'
    doc = rig_document()
    doc["cameras"][0]["name"] = name
    rig.write_text(json.dumps(doc))
    assert says in refused("patterns", rig, "--out", tmp_path / "out")
    change(capture, lambda d: d["views"][0].update(camera=name))
    assert says in refused("decode", capture, "--out", tmp_path / "out")
    assert says in refused("reconstruct", capture, "--rig", rig, "--out", tmp_path / "out")


def test_every_file_beside_a_camera_s_folder_is_no_camera_s_name(capture: Path, tmp_path: Path) -> None:
    """Whatever the verbs leave beside the folders: a new file of theirs must be refused as a name too."""
    assert run(["decode", str(capture), "--out", str(tmp_path / "d")]) == 0
    scan = ["simulate", "plane", "--preset", "single", "--scale", "0.04", "--out", str(tmp_path / "c")]
    assert run(scan) == 0
    true = str(tmp_path / "c" / "truth" / "rig.json")
    assert run(["reconstruct", str(tmp_path / "c"), "--rig", true, "--out", str(tmp_path / "s")]) == 0
    assert run(["patterns", true, "--out", str(tmp_path / "p")]) == 0
    beside = {p.name for folder in "dcsp" for p in (tmp_path / folder).iterdir() if p.is_file()}
    assert {"scan.json", "cloud.ply", "surface.glb", "view.html", "decoded.json", "plan.json"} <= beside
    assert [n for n in sorted(beside) if check_name(n) is None] == []


# ------------------------------------------------------------------------------------------------------------ outputs


def test_outputs_that_are_there_already(
    capture: Path, tmp_path: Path, refused: Callable[..., str], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "scan").mkdir()
    (tmp_path / "scan/scan.json").write_text("{}")
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes/my.txt").write_text("mine")
    (tmp_path / "file").write_text("mine")
    for out in ("scan", "notes", "file", "capture"):
        for force in ([], ["--force"]):
            refused("decode", capture, "--out", tmp_path / out, *force)
    assert run(["decode", str(capture), "--out", str(tmp_path / "d")]) == 0
    capsys.readouterr()
    line = refused("decode", capture, "--out", tmp_path / "d")
    assert "--force" in line
    assert run(["decode", str(capture), "--out", str(tmp_path / "d"), "--force"]) == 0
    capsys.readouterr()
    # what fails with --force leaves the old result
    (capture / "camera1/07.png").unlink()
    refused("decode", capture, "--out", tmp_path / "d", "--force")


def test_no_permission(
    capture: Path, tmp_path: Path, refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    assert "file, not a folder" in refused("decode", capture, "--out", tmp_path / "file" / "out")

    def denied(*_: Any, **__: Any) -> str:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("fringescope.store.files.tempfile.mkdtemp", denied)
    assert "no permission" in refused("decode", capture, "--out", tmp_path / "out")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EIO])
def test_a_full_disk(
    capture: Path, tmp_path: Path, refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    whole = Path.write_bytes

    def full(self: Path, data: Any) -> int:
        if self.name == "reasons.png":
            whole(self, bytes(data)[:10])
            raise OSError(number, "full")
        return whole(self, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    line = refused("decode", capture, "--out", tmp_path / "out")
    assert "cannot write" in line


@pytest.mark.skipif(sys.platform == "win32", reason="limits of a process are a POSIX matter")
def test_files_that_the_system_refuses(capture: Path, tmp_path: Path) -> None:
    """The real thing: the operating system stops a write at 4 KiB."""
    code = (
        "import resource, sys; from fringescope.cli import run; "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096)); sys.exit(run(sys.argv[1:]))"
    )
    before = tree(tmp_path)
    command = [sys.executable, "-c", code, "decode", str(capture), "--out", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr
    lines = [x for x in done.stderr.splitlines() if not re.fullmatch(r".+: \d+\.\d s", x)]
    assert len(lines) == 1, done.stderr
    assert "cannot write" in lines[0]
    assert tree(tmp_path) == before


def test_a_failed_import_leaves_nothing(tmp_path: Path, refused: Callable[..., str]) -> None:
    (tmp_path / "in").mkdir()
    for i in range(4):
        cv2.imwrite(str(tmp_path / f"in/{i}.png"), np.zeros((8, 9), np.uint8))
    args = ["import", tmp_path / "in", "--out", tmp_path / "out"]
    assert "no modulated pixel" in refused(*args, "--steps", "4", "--periods", "36")
    refused(*args, "--steps", "3", "--periods", "36")
    refused(*args, "--steps", "2", "--periods", "36", status=2)
    refused(*args, "--steps", "4", "--periods", "nan", status=2)
    refused(*args, "--steps", "4", "--periods", "36", "--direction", "w", status=2)
    refused(*args, "--steps", "4", "--periods", "36", "--projector", "912", status=2)
    refused(*args, "--steps", "4", "--periods", "36", "--camera", "../x", status=2)
    nowhere = ["import", tmp_path / "nowhere", *args[2:], "--steps", "4", "--periods", "36"]
    assert "--camera ../x" in refused(*nowhere, "--camera", "../x", status=2)  # said before anything is read
    shutil.copy(tmp_path / "in/0.png", tmp_path / "in/4.png")
    assert "5 images" in refused(*args, "--steps", "4", "--periods", "36")
