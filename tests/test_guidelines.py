"""Guidelines files, the verb `guide` and `pattern.json`: what outsiders read and write."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fringescope import cli, export, geometry, guide, store
from fringescope.errors import FormatError, GuidanceError
from fringescope.pipeline import carrying, guidance
from fringescope.settings import Settings
from fringescope.store.guidelines import parse_colour
from fringescope.types import Fill, Guidelines, Pose, Rig, Side, Stroke, StrokeKind
from tests.guide_scenes import to_line

S = Settings()


def write(path: Path, strokes: Any, **more: Any) -> Path:
    doc = {"format": "fringescope-guidelines", "version": 1, "strokes": strokes, **more}
    path.write_text(json.dumps(doc))
    return path


LINE = {"id": "cut-1", "camera": "camera1", "pixels": [[60, 60], [110, 70]], "width_mm": 0.6, "color": "#ff3030"}


# --------------------------------------------------------------------------------------------------------------- file


def test_every_kind_is_read(tmp_path: Path) -> None:
    strokes = [
        {**LINE, "kind": "line", "closed": False},
        {"id": "cut-2", "world_mm": [[1, 2, 3], [4, 5, 6]], "width_px": 3, "color": "#00ff80", "unknown": 1},
        {**LINE, "id": "r", "kind": "region", "pixels": [[1, 2], [3, 4], [5, 1]], "fill": "hatch", "spacing_mm": 1.5},
        {**LINE, "id": "c", "kind": "circle", "pixels": [[5, 6]], "radius_mm": 4},
        {**LINE, "id": "o", "kind": "offsets", "spacing_mm": 5, "count": 3, "side": "both"},
        {**LINE, "id": "t", "kind": "text", "text": "margin", "size_mm": 2.5},
        {**LINE, "id": "a", "kind": "arrow", "color": "#f00"},
    ]
    g = store.read_guidelines(write(tmp_path / "g.json", strokes, scan="sha256:1"))
    assert not g.refused
    assert [s.kind for s in g.strokes][2:] == [
        StrokeKind.REGION, StrokeKind.CIRCLE, StrokeKind.OFFSETS, StrokeKind.TEXT, StrokeKind.ARROW
    ]  # fmt: skip
    assert (g.scan, g.rig) == ("sha256:1", None)
    assert g.strokes[2].fill is Fill.HATCH
    assert g.strokes[4].side is Side.BOTH
    assert g.strokes[0].color == (255, 48, 48)
    assert g.strokes[6].color == (255, 0, 0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"color": "mauve"}, 'color is "mauve"; needed #rrggbb'),
        ({"color": 7}, "color is 7"),
        ({"width_mm": "wide"}, "width_mm is"),
        ({"width_mm": -1}, "needed 0.01 to 20"),
        ({"kind": "spline"}, "there are line, region, circle, arrow, offsets, text"),
        ({"kind": "region", "fill": "dots"}, "there are none, solid, hatch"),
        ({"pixels": "here"}, "needed a list of points"),
        ({"pixels": [[1, 2], [None, 3]]}, "NaN|not numbers"),
        ({"pixels": [[1, 2], {"u": 3}]}, "not numbers"),
        ({"pixels": []}, "shape"),
        ({"pixels": [["1", "2"], ["3", "4"]]}, "not numbers"),
        ({"pixels": [[True, False], [False, True]]}, "not numbers"),
        ({"pixels": [[1, 2], [3, 1e308]]}, "reaches to 1e\\+308"),
        ({"pixels": [[5, 5], [5, 5]]}, "all its points are the same"),
        ({"kind": "offsets", "spacing_mm": 100, "count": 100}, "needed at most 200 mm"),
        ({"kind": "text", "text": "\u200b"}, "printable"),
        ({"kind": "text", "text": "x" * 101}, "printable"),
        ({"closed": "yes"}, "closed is"),
        ({"count": 2.5}, "count is 2.5"),
        ({"camera": 3}, "camera is 3"),
        ({"world_mm": [[1, 2, 3], [1, 2, 4]]}, "both"),
    ],
)
def test_a_bad_stroke_is_refused_by_name_and_the_rest_is_read(tmp_path: Path, change: Any, words: str) -> None:
    g = store.read_guidelines(write(tmp_path / "g.json", [{**LINE, "id": "bad", **change}, LINE]))
    assert [s.id for s in g.strokes] == ["cut-1"]
    assert list(g.refused) == ["bad"]
    with pytest.raises(GuidanceError, match=words):
        raise GuidanceError(g.refused["bad"])


@pytest.mark.parametrize(
    ("doc", "words"),
    [
        ({"format": "fringescope-rig", "version": 1}, "format"),
        ({"format": "fringescope-guidelines", "version": 2, "strokes": []}, "version"),
        ({"format": "fringescope-guidelines", "version": 1}, "needed a list of strokes"),
        ({"format": "fringescope-guidelines", "version": 1, "strokes": [], "scan": 5}, '"scan" is 5'),
    ],
)
def test_files_that_are_no_guidelines(tmp_path: Path, doc: Any, words: str) -> None:
    (tmp_path / "g.json").write_text(json.dumps(doc))
    with pytest.raises(FormatError, match=words):
        store.read_guidelines(tmp_path / "g.json")


def test_strokes_without_an_id_or_that_are_none(tmp_path: Path) -> None:
    names = ["", "two\nlines", "\ud800", "\x1b[31m"]
    g = store.read_guidelines(write(tmp_path / "g.json", [5, *({**LINE, "id": n} for n in names), LINE, LINE]))
    assert list(g.refused) == [f"strokes[{i}]" for i in (0, 1, 2, 3, 4, 6)]
    assert "needed one of its own" in g.refused["strokes[6]"]
    assert len(g.strokes) == 1
    assert parse_colour("Green") == (0, 255, 128)


# --------------------------------------------------------------------------------------------------------------- verb


@pytest.fixture(scope="module")
def scanned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small scan of a domed specimen, by the true rig."""
    at = tmp_path_factory.mktemp("guide")
    assert cli.run(["simulate", "tissue-domed", "--out", str(at / "capture"), "--scale", "0.05", "--seed", "3"]) == 0
    rig = str(at / "capture" / "truth" / "rig.json")
    assert cli.run(["reconstruct", str(at / "capture"), "--rig", rig, "--out", str(at / "scan")]) == 0
    return at


def call(scanned: Path, guidelines: Path, out: Path, *more: str) -> int:
    rig = str(scanned / "capture" / "truth" / "rig.json")
    return cli.run(["guide", str(scanned / "scan"), str(guidelines), "--rig", rig, "--out", str(out), *more])


ON_TISSUE = [[120, 80], [150, 95], [180, 90]]


def test_the_verb_writes_picture_record_and_previews(
    scanned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    strokes = [
        {**LINE, "pixels": ON_TISSUE},
        {**LINE, "id": "off", "pixels": [[-50, -50], [-60, -70]]},
        {**LINE, "id": "bad", "color": "none"},
    ]
    out = tmp_path / "new" / "pattern.png"
    assert call(scanned, write(tmp_path / "g.json", strokes), out, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    doc = json.loads(out.with_suffix(".json").read_text())
    assert {s["id"] for s in doc["strokes"]} == {"cut-1", "off", "bad"}
    first = doc["strokes"][0]
    assert {"id", "segments", "hidden", "expected_error_um"} <= set(first)
    assert first["segments"]
    assert 0 < first["expected_error_um"] < 100
    assert all({"segment", "why"} <= set(h) for h in first["hidden"])
    assert "refused" in doc["strokes"][1]
    assert "#rrggbb" in doc["strokes"][2]["refused"]
    image = cv2.imread(str(out))
    assert image.shape == (1140, 912, 3)
    assert image[..., 2].max() == 255  # red
    lit = np.argwhere(image.max(2) > 127)[:, ::-1].astype(float)
    plane = np.stack([2 * lit[:, 0] + lit[:, 1] % 2, lit[:, 1]], 1)
    assert max(to_line(plane, np.array(s)).max() for s in first["segments"][:1]) < 40
    assert sorted(p.name for p in out.parent.iterdir()) == [
        "pattern-camera1.png", "pattern-camera2.png", "pattern-camera3.png", "pattern.json", "pattern.png"
    ]  # fmt: skip
    assert told["scan"].startswith("sha256:")
    kept = write(out.with_name("pattern.json"), strokes)  # guidelines are never replaced, whatever --force says
    assert call(scanned, kept, out, "--force") == 2
    assert json.loads(kept.read_text())["strokes"][0]["id"] == "cut-1"
    # again: refused without --force, before anything is projected, and nothing is lost
    before = out.read_bytes()
    assert call(scanned, tmp_path / "g.json", out, "--verify", "--device", "sim://no/such") == 1
    assert "--force" in capsys.readouterr().err
    assert call(scanned, tmp_path / "g.json", out) == 1
    assert "--force" in capsys.readouterr().err
    assert out.read_bytes() == before
    assert call(scanned, tmp_path / "g.json", out, "--force", "--no-preview") == 1
    assert "is no record of guidance" in capsys.readouterr().err
    kept.unlink()
    assert call(scanned, tmp_path / "g.json", out, "--force", "--no-preview") == 0
    assert call(scanned, tmp_path / "g.json", out, "--force", "--no-preview") == 0


@pytest.mark.parametrize(
    ("more", "words"),
    [({"scan": "sha256:" + "0" * 64}, "belong to scan"), ({"rig": "sha256:" + "0" * 64}, "belong to rig")],
)
def test_guidelines_of_another_scan_or_rig_are_refused(
    scanned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: Any, words: str
) -> None:
    g = write(tmp_path / "g.json", [{**LINE, "pixels": ON_TISSUE}], **more)
    assert call(scanned, g, tmp_path / "p.png") == 1
    assert words in capsys.readouterr().err
    assert not (tmp_path / "p.png").exists()


def test_another_rig_than_the_scan_s(scanned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = json.loads((scanned / "capture" / "truth" / "rig.json").read_text())
    rig["cameras"][0]["t"][2] += 0.1
    (tmp_path / "rig.json").write_text(json.dumps(rig))
    g = write(tmp_path / "g.json", [{**LINE, "pixels": ON_TISSUE}])
    args = ["guide", str(scanned / "scan"), str(g), "--rig", str(tmp_path / "rig.json"), "--out"]
    assert cli.run([*args, str(tmp_path / "p.png")]) == 1
    assert "not the rig" in capsys.readouterr().err
    assert cli.run([*args, str(tmp_path / "p.tif")]) == 2


def test_nothing_to_show_is_an_error_and_no_strokes_is_darkness(
    scanned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    g = write(tmp_path / "g.json", [{**LINE, "pixels": [[-50, -50], [-60, -70]]}])
    assert call(scanned, g, tmp_path / "p.png") == 1
    assert "nothing can be shown" in capsys.readouterr().err
    assert not (tmp_path / "p.png").exists()
    assert call(scanned, write(tmp_path / "e.json", []), tmp_path / "p.png") == 0
    assert not cv2.imread(str(tmp_path / "p.png")).any()


def test_verify_closes_the_loop_on_the_simulated_instrument(
    scanned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    g = write(tmp_path / "g.json", [{**LINE, "pixels": ON_TISSUE, "color": "#ffffff", "width_mm": 1.0}])
    assert call(scanned, g, tmp_path / "p.png", "--verify", "--json") == 0
    told = json.loads(capsys.readouterr().out)["strokes"][0]["landed"]
    assert told["share"] > 0.8
    assert told["median_um"] < 40
    assert told["p95_um"] < 120
    assert (tmp_path / "p-camera2-landed.png").exists()


# --------------------------------------------------------------------------------------------------------- carried over


def test_strokes_are_carried_to_where_the_tissue_went(scanned: Path) -> None:
    scan, rig = store.read_scan(scanned / "scan"), store.read_rig(scanned / "capture" / "truth" / "rig.json")
    assert scan.surface is not None
    tissue = guidance.tissue_of(scan.grids, export.read_glb(scan.surface), rig, S)
    before = export.read_ply(scan.cloud)
    turn = cv2.Rodrigues(np.array([0.0, 0.0, np.radians(2.0)]))[0]
    T = Pose(turn, np.array([1.5, -0.8, 0.2]))
    after = replace(
        before,
        xyz=geometry.transform(T, before.xyz).astype(np.float32),
        normals=(before.normals.astype(np.float64) @ T.R.T).astype(np.float32),
    )
    line = Stroke("cut-1", camera="camera1", pixels=np.array(ON_TISSUE, float), width_mm=0.6)
    ring = Stroke("ring", StrokeKind.CIRCLE, camera="camera1", pixels=np.array(ON_TISSUE[:1], float), radius_mm=3)
    off = Stroke("off", camera="camera1", pixels=np.array([[-50.0, -50], [-60, -70]]))
    found = carrying.carry_over(Guidelines((line, ring, off)), tissue, before, after, rig, S)
    assert found.guidelines.strokes[0].id == "cut-1"
    assert list(found.guidelines.refused) == ["off"]
    assert found.registration.shift_mm == pytest.approx(1.7, abs=0.3)
    here = guide.place(line, tissue, S.guide)[0].traces[0].xyz
    want = geometry.transform(T, here[np.isfinite(here).all(1)])
    got = found.guidelines.strokes[0].points
    assert to_line(got, want).max() < 0.02
    assert found.expected_error_um["cut-1"] < 100
    assert found.guidelines.strokes[0].width_mm == 0.6


def test_the_verb_offers_and_the_operator_decides(
    scanned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = str(scanned / "capture" / "truth" / "rig.json")
    again = ["reconstruct", str(scanned / "capture"), "--rig", rig, "--out", str(tmp_path / "again")]
    assert cli.run([*again, "--set", "fuse.agree_mm=0.06"]) == 0
    old = store.read_scan(scanned / "scan").document["hash"]
    g = write(tmp_path / "g.json", [{**LINE, "pixels": ON_TISSUE}], scan=old)
    scans = [str(scanned / "scan"), str(tmp_path / "again")]
    to = ["carry", *scans, str(g), "--rig", rig, "--out", str(tmp_path / "n.json")]
    assert cli.run(to) == 0
    assert "the specimen moved by 0.00 mm" in capsys.readouterr().out
    carried = store.read_guidelines(tmp_path / "n.json")
    assert carried.scan == store.read_scan(tmp_path / "again").document["hash"]
    assert carried.strokes[0].world_mm is not None
    assert (carried.strokes[0].width_mm, carried.strokes[0].color) == (0.6, (255, 48, 48))
    args = ["guide", str(tmp_path / "again"), str(tmp_path / "n.json"), "--rig", rig, "--out", str(tmp_path / "p.png")]
    assert cli.run([*args, "--no-preview"]) == 0
    assert cli.run([*args[:2], str(g), *args[3:], "--force"]) == 1  # the old ones do not fit the new scan
    assert "carry them over" in capsys.readouterr().err
    assert cli.run(to) == 1  # it is there already
    missing = write(tmp_path / "m.json", [{**LINE, "pixels": [[-50, -50], [-60, -70]]}])
    assert cli.run([*to[:3], str(missing), *to[4:6], "--out", str(tmp_path / "o.json")]) == 1
    assert "nothing can be carried over" in capsys.readouterr().err


def test_guidelines_are_written_as_they_are_read(tmp_path: Path) -> None:
    strokes = [
        {**LINE, "id": "r", "kind": "region", "pixels": [[1, 2], [3, 4], [5, 1]], "fill": "hatch", "spacing_mm": 1.5},
        {"id": "o", "kind": "offsets", "world_mm": [[0, 0, 1], [5, 0, 1]], "count": 3, "side": "both", "width_px": 2},
        {"id": "t", "kind": "text", "world_mm": [[0, 0, 1]], "text": "margin", "size_mm": 2.5, "color": "#102030"},
    ]
    first = store.read_guidelines(write(tmp_path / "a.json", strokes, rig="sha256:2"))
    store.write_json(tmp_path / "b.json", store.guidelines_document(first))
    second = store.read_guidelines(tmp_path / "b.json")
    assert (second.rig, second.scan) == ("sha256:2", None)
    for a, b in zip(first.strokes, second.strokes, strict=True):
        for f in fields(Stroke):
            assert np.array_equal(getattr(a, f.name), getattr(b, f.name)), f.name


# ----------------------------------------------------------------------------------------------------- rendered tissue


@pytest.fixture(scope="module")
def rendered(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[guide.Tissue, Rig, Any]:
    """The tissue of the path tracer, scanned with its true rig; and its true surface, by Embree."""
    from fringescope.twin import shapes
    from fringescope.twin.textures import Finish, uniform

    data = shared / "data" / "rendered-small"
    at = tmp_path_factory.mktemp("rendered") / "scan"
    rig = data / "truth" / "rig.json"
    assert cli.run(["reconstruct", str(data / "tissue"), "--rig", str(rig), "--out", str(at)]) == 0
    scan, r = store.read_scan(at), store.read_rig(rig)
    assert scan.surface is not None
    mesh = np.load(data / "truth" / "tissue_mesh.npz")
    V, F = mesh["V"].astype(float), mesh["F"]
    normal = np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]])
    N = np.zeros_like(V)
    for k in range(3):
        np.add.at(N, F[:, k], normal)
    N /= np.linalg.norm(N, axis=1, keepdims=True) + 1e-30
    N *= np.sign(np.median(N[:, 2]))
    truth = shapes.Mesh(Finish(uniform((0.5, 0.5, 0.5))), V, N, F)
    return guidance.tissue_of(scan.grids, export.read_glb(scan.surface), r, S), r, truth


def freehand(rng: np.random.Generator, width: int, height: int, n: int = 160) -> np.ndarray:
    a = np.cumsum(rng.normal(0, 0.06, n)) + rng.uniform(0, 7)
    pace = rng.uniform(0.5, 1.4) * width / 684
    p = rng.uniform([0.3 * width, 0.3 * height], [0.7 * width, 0.7 * height])
    p = p + np.cumsum(np.stack([np.cos(a), np.sin(a)], 1) * pace, 0)
    return p[((p > 0) & (p < [width - 1, height - 1])).all(1)]


@pytest.mark.parametrize("seeds", [12, pytest.param(300, marks=pytest.mark.verify)])
def test_strokes_on_the_rendered_tissue(rendered: Any, record_property: Any, seeds: int) -> None:
    """Median within 20 um, p95 within 80 um, and at least 95 % of what camera and projector see is covered."""
    from fringescope.twin import optics, shapes

    t, r, truth = rendered
    p = r.projector
    light = geometry.centre(p.pose)
    errors, covered, seen = [], 0, 0
    for seed in range(seeds):
        rng = np.random.default_rng([seed, 9])
        camera = r.cameras[seed % 3]
        pixels = freehand(rng, camera.lens.width, camera.lens.height)
        o, d = optics.look(camera.lens, camera.pose, pixels)
        h = shapes.trace((truth,), o, d)
        visible = (h.shape == 0) & shapes.lit((truth,), h.point, h.normal, light)
        if visible.sum() < 20:
            continue
        made = guide.guide(Guidelines((Stroke("a", camera=camera.name, pixels=pixels, width_mm=0.6),)), t, S.guide)
        want = geometry.project(p, h.point)
        depth = float(np.nanmean(geometry.transform(p.pose, h.point)[visible, 2]))
        scale = depth / np.array([p.lens.K[0, 0], p.lens.K[1, 1]])  # mm per unit
        off = np.full(len(want), np.inf)
        for s in made.strokes[0].segments:
            off = np.minimum(off, to_line(want * scale, s * scale))
        near = visible & (off < 0.15)
        errors.append(1e3 * off[near])
        covered, seen = covered + int(near.sum()), seen + int(visible.sum())
    every = np.concatenate(errors)
    figures = {"median_um": np.median(every), "p95_um": np.percentile(every, 95), "covered": covered / seen}
    for name, value in figures.items():
        record_property(name, float(value))
    assert figures["median_um"] <= 20
    assert figures["p95_um"] <= 80
    assert figures["covered"] >= 0.95
