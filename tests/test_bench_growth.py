"""The growth of cost: what is timed, and its drawing."""

import xml.etree.ElementTree as ET

import pytest

from fringescope import bench, cli
from fringescope.bench import growth, plot
from fringescope.types import FringeSet


def fake(ns):
    return {"copy_floor": 0.1 * ns, "decode_triangulate": ns, "one_view": 2 * ns}


def test_more_frames_are_more_frames(monkeypatch):
    monkeypatch.setattr(growth, "FEW", 0.02)
    seen = []

    def timer(_rig, view):
        seen.append((len(view.frames), [one.steps for one in view.plan.sets if isinstance(one, FringeSet)]))
        return {"one_view": 1e-3}

    out = growth.frames(timer, lambda *_: None)
    assert [n for n, _ in seen] == [12, 16, 32, 64]
    assert [sum(steps) for _, steps in seen] == [12, 16, 32, 64]
    assert out["16"]["one_view"] == pytest.approx(1e3 * 1e-3 / 0.02)


def test_pixels_keep_what_was_timed_already(monkeypatch):
    monkeypatch.setattr(growth, "SIZES", (0.02, 0.03))
    calls = []
    out = growth.pixels(0.05, fake(1e-3), lambda _rig, view: calls.append(view) or fake(2e-3), lambda *_: None)
    assert list(out) == ["0.02", "0.03", "0.05"]
    assert len(calls) == 2
    assert out["0.05"]["one_view"] == pytest.approx(1e3 * 2e-3 / 0.05)


def test_the_drawing_has_a_line_for_each_cost_in_each_panel():
    by = {"0.25": fake(30.0), "1": fake(25.0), "20": fake(24.0)}
    result = {
        "ns_per_pixel": by, "ns_per_pixel_by_frames": {"12": fake(20.0), "16": fake(22.0)},
        "ns_per_pixel_by_cores": {"1": fake(44.0)}, "growth_megapixels": 5.0, "machine": "a & b", "date": "2026-01-01",
    }  # fmt: skip
    root = ET.fromstring(plot.drawing(result))
    circles = [e for e in root.iter() if e.tag.endswith("circle")]
    assert len(circles) == 3 * (3 + 2 + 1)
    width, height = map(float, root.attrib["viewBox"].split()[2:])
    assert all(0 < float(c.attrib["cx"]) < width and 0 < float(c.attrib["cy"]) < height for c in circles)
    words = " ".join(e.text or "" for e in root.iter() if e.tag.endswith("text"))
    assert "a & b" in words
    assert "megapixels" in words
    assert "cores, 5 megapixels" in words
    result["ns_per_pixel_by_cores"] = {}
    assert len([e for e in ET.fromstring(plot.drawing(result)).iter() if e.tag.endswith("circle")]) == 15


def test_a_drawing_that_cannot_be_written_is_refused_before_the_work(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(bench, "measure", lambda *_args, **_more: pytest.fail("it began"))
    for where in (tmp_path, tmp_path / "none" / "growth.svg"):
        assert cli.run(["bench", "--plot", str(where)]) == 1
        assert "needed a file in a folder that exists" in capsys.readouterr().err
