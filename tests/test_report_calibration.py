"""The calibration report: a page without network or script, true to its figures; of a failed one too."""

import dataclasses
import html.parser
import re
import subprocess
import tempfile

import cv2
import numpy as np
import pytest

from fringescope import report
from fringescope.calibrate.evidence import evidence
from fringescope.report import svg
from fringescope.settings import EvidenceSettings
from fringescope.types import HeldOut, LeftOut, Sighting
from tests.calibration_scenes import calibration

VOID = {"meta", "br", "img"}


@pytest.fixture(scope="module")
def solved():
    c = calibration("paper", n=10, sigma=0.01)
    held = [HeldOut(p, 200, 0.004, 0.012, 0.03, 3.0, 1.00002) for p in c.boards]
    return c, evidence(c, held, EvidenceSettings(permutations=200))


def overlays(c, size=(300, 200)):
    return {s.name: np.full((size[1], size[0], 3), 90, np.uint8) for s in c.sightings}


class Tags(html.parser.HTMLParser):
    """Notes tags that are never closed, and all attributes."""

    def __init__(self, text):
        super().__init__()
        self.open, self.attributes, self.words = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.attributes += [(tag, *a) for a in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.attributes += [(tag, *a) for a in attrs]

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def test_the_page_is_whole_and_needs_nothing(solved):
    c, e = solved
    page = report.calibration_page(c, e, c.sightings, None, overlays(c))
    tags = Tags(page)
    assert tags.open == []
    assert "<script" not in page
    assert "default-src 'none'" in page
    assert not [a for a in tags.attributes if a[1] in ("src", "href") and not a[2].startswith(("data:", "#"))]
    assert not re.search(r"url\(|@import|@[A-Z]+@", page)
    assert "NaN" not in page
    assert "nan" not in " ".join(tags.words).split()
    assert len(page) < 6_000_000


def test_the_first_screen_says_what_it_is_worth(solved):
    c, e = solved
    page = report.calibration_page(c, e, c.sightings)
    first = page[: page.index("<h2>")]
    assert e.verdict == "good"
    assert ">Good<" in first
    for words in (*e.good, *e.weak, *e.next):
        assert words.split(":")[0].split(",")[0].lower()[:30] in first.lower()
    assert "4.0 µm" in first
    for pose in c.boards:
        assert f"<td>{pose}</td>" in page
    for k in ("projector", "camera1", "camera2", "camera3"):
        assert page.lower().count(k) > 3
    bad = report.calibration_page(c, dataclasses.replace(e, verdict="do not use"), c.sightings)
    assert ">Do not use<" in bad


def test_what_people_wrote_is_escaped(solved):
    c, e = solved
    left = LeftOut("pose01", "camera1", 3, "<b>bad</b> & worse")
    odd = dataclasses.replace(c, left_out=(left,))
    page = report.calibration_page(odd, dataclasses.replace(e, weak=("<img src=x>",)), c.sightings, title="a<b>c")
    assert "<b>bad" not in page
    assert "&lt;b&gt;bad&lt;/b&gt; &amp; worse" in page
    assert "<img src=x" not in page
    assert "<title>a&lt;b&gt;c</title>" in page


def test_a_failed_calibration_gets_a_page(solved):
    c, _ = solved
    some = [s for s in c.sightings if s.camera != "camera2" and s.pose in ("pose00", "pose01", "pose03")]
    some = [dataclasses.replace(s, words=("4 squares left out: saturated",)) for s in some]
    pictures = {f"{p}/{k}": np.zeros((50, 70), np.uint8) for p in ("pose00", "pose01", "pose03", "pose04")
                for k in ("camera1", "camera2", "camera3")}  # fmt: skip
    page = report.calibration_page(None, None, some, "all 3 poses are parallel within 2 deg", pictures)
    assert Tags(page).open == []
    assert "No calibration" in page
    assert "parallel within 2 deg" in page
    assert "camera2 found no board" in page
    assert "no board in pose04" in page.lower()
    assert "3 poses show the board" in page
    assert page.count("saturated") >= 3
    assert page.count("data:image/jpeg") == 12


@pytest.mark.parametrize("pictures", [{}, {"pose00/camera1": np.zeros((8, 8, 3), np.uint8)}])
def test_nothing_found_at_all_gets_a_page(pictures):
    page = report.calibration_page(None, None, (), "no board in any of 8 pictures", pictures)
    assert Tags(page).open == []
    assert "check that board.json" in page


def test_pictures_shrink_until_the_page_is_small_enough(rng):
    noise = rng.integers(0, 255, (900, 1200, 3), np.uint8)
    big = {f"pose{i:02}/camera{j}": noise for i in range(10) for j in (1, 2, 3)}
    page = report.calibration_page(None, None, (), "failed", big)
    assert len(page) < 6_000_000
    assert page.count("data:image/jpeg") == 30


def test_bare_calibrations_are_drawn_too(solved):
    c, _ = solved
    s = EvidenceSettings(permutations=200)
    single = calibration("single", n=3)
    variants = [
        dataclasses.replace(c, residuals=()),
        dataclasses.replace(single, covariance=np.zeros((0, 0)), left_out=()),
        dataclasses.replace(single, parameters=()),
        calibration("five", n=2),
    ]
    for v in variants:
        page = report.calibration_page(v, evidence(v, (), s), v.sightings)
        assert Tags(page).open == []
        assert not re.search(r'="[^"]*\bnan\b', page)


# --------------------------------------------------------------------------------------------------------- drawings


def moves(drawing, tag="M"):
    return np.array(re.findall(rf"{tag}(-?[\d.]+) (-?[\d.]+)l(-?[\d.]+) (-?[\d.]+)", drawing), dtype=float)


def test_arrows_stand_and_point_where_they_should():
    rows = [(0.0, 0.0, 0.01, 0.0), (341.5, 227.5, 0.0, 0.01), (683.0, 455.0, -0.01, 0.0)]
    found = moves(svg.arrows(rows, (684, 456), "px", "#000"))
    k = 420 / 684
    assert found[:, :2] == pytest.approx((np.array(rows)[:, :2] + 0.5) * k, abs=0.06)
    assert found[0, 2] > 10
    assert found[1, 3] == pytest.approx(found[0, 2])
    assert found[2, 2] == pytest.approx(-found[0, 2])
    half = moves(svg.arrows(rows, (684, 456), "px", "#000", 0.02))
    assert half[0, 2] == pytest.approx(found[0, 2] / 2, abs=0.1)


def test_the_scale_bar_is_as_long_as_it_says():
    drawing = svg.arrows([(100.0, 100.0, 0.03, 0.04)], (684, 456), "px", "#000")
    arrow = np.hypot(*moves(drawing)[0, 2:])
    bar = float(re.search(r"M4 [\d.]+h([\d.]+)", drawing).group(1))
    said = float(re.search(r"([\d.]+) px</text>", drawing).group(1))
    assert bar / said == pytest.approx(arrow / 0.05, rel=0.02)


def test_a_compass_shows_right_to_the_right_and_down_below():
    drawing = svg.compass([("pose01", np.radians(10), 0.0), ("pose02", np.radians(20), np.pi / 2)])
    points = np.array(re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)" r="4"', drawing), dtype=float)
    middle = np.array([150, 118])
    assert points[0] - middle == pytest.approx([44, 0], abs=0.1)
    assert points[1] - middle == pytest.approx([0, 88], abs=0.1)


def test_a_map_has_its_rows_upwards_and_its_colours_in_order():
    drawing = svg.heat([[1.0, 2.0], [3.0, float("nan")]], (0, 20, 0, 20), 1, 3, "z")
    rects = re.findall(r'<rect x="([\d.]+)" y="([\d.]+)"[^>]*fill="(#\w+)"', drawing)
    assert len(rects) == 3
    assert float(rects[0][1]) > float(rects[2][1])
    assert [r[2] for r in rects] == [svg.shade(0), svg.shade(0.5), svg.shade(1)]


@pytest.mark.parametrize(
    ("value", "shown"),
    [(0.01234, "0.012"), (4.06, "4.1"), (24.4, "24"), (12345.6, "12000"), (-0.5, "−0.50"), (1.23e-8, "1.2·10⁻⁸"),
     (float("nan"), "–"), (0.0, "0"), (1e12, "1.0·10¹²")],
)  # fmt: skip
def test_numbers_as_people_write_them(value, shown):
    assert svg.number(value) == shown


# ---------------------------------------------------------------------------------------------------------- pictures


def near(picture, place, colour, reach=4):
    u, v = (round(x) for x in place)
    part = picture[max(v - reach, 0) : v + reach + 1, max(u - reach, 0) : u + reach + 1].astype(int)
    return (np.abs(part - colour).max(axis=-1) < 60).any()


def test_a_sighting_is_drawn_where_things_are(solved):
    c, _ = solved
    s, r = c.sightings[4], c.residuals[4]
    corner = r.corner.copy()
    corner[5] = np.nan
    image = np.full((s.size[1], s.size[0]), 40, np.float32)
    picture = report.sighting_picture(image, s, dataclasses.replace(r, corner=corner))
    assert picture.shape == (912, 1368, 3)  # drawn twice as large
    place = (s.corner_px + 0.5) * 2 - 0.5
    ring = [near(picture, p, (255, 196, 0), 9) for p in place]
    assert np.mean(ring) > 0.95
    assert near(picture, place[5], (255, 60, 60), 9)
    assert not near(picture, place[20], (255, 60, 60), 5)
    assert near(picture, place[0], (255, 255, 255))
    inside = (s.sample_px + 0.5) * 2 - 0.5
    assert np.mean([near(picture, p, (70, 190, 255), 2) for p in inside]) > 0.9


@pytest.mark.parametrize("shape", [(456, 684), (456, 684, 3), (2000, 3000)])
def test_any_kind_of_picture_can_be_drawn_on(shape, rng):
    image = rng.integers(0, 4000, shape).astype(np.uint16)
    empty = Sighting("p", "c", (shape[1], shape[0]), np.zeros((0, 2), np.int32), np.zeros((0, 2)), np.zeros(0),
                     np.zeros((0, 2), np.int32), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2)),
                     np.zeros((0, 2)), np.zeros((0, 0)), np.zeros((0, 0)))  # fmt: skip
    picture = report.sighting_picture(image, empty)
    assert picture.dtype == np.uint8
    assert picture.ndim == 3
    assert max(picture.shape) <= 1400


def test_a_mosaic_is_drawn_without_its_pattern():
    image = np.full((100, 140), 100, np.float32)
    image[::2, ::2] = 30
    image[:, 70:] *= 2
    grey = report.sighting.grey_picture(image)[4:-4]
    assert np.ptp(grey[:, 5:60]) < 8
    assert grey[:, 80:].mean() > grey[:, 5:60].mean() + 50


@pytest.mark.parametrize("width", [1280, 390])
def test_a_browser_draws_it_without_a_word_of_complaint(solved, chromium, tmp_path, width):
    c, e = solved
    path, shot = tmp_path / "report.html", tmp_path / "shot.png"
    path.write_text(report.calibration_page(c, e, c.sightings, None, overlays(c)), encoding="utf-8")
    with tempfile.TemporaryDirectory() as profile:
        done = subprocess.run(
            [chromium, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run",
             "--disable-background-networking", f"--user-data-dir={profile}", f"--window-size={width},900",
             "--enable-logging=stderr", f"--screenshot={shot}", path.as_uri()],
            capture_output=True, text=True, timeout=120, check=True,
        )  # fmt: skip
    assert "CONSOLE" not in done.stderr
    picture = cv2.imread(str(shot))
    green = (np.abs(picture.astype(int) - (91, 143, 47)).max(axis=-1) < 12).sum()
    assert green > 500  # the verdict, in its colour, on the first screen


def test_no_table_is_cut_off_on_a_screen_1200_wide(solved, chromium, tmp_path):
    c, e = solved
    assert any(p.notes for p in e.poses)
    page = report.calibration_page(c, e, c.sightings)
    assert f"Boards reached <b>{100 * e.filled.share:.0f} %</b>" in page
    page = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page)
    ask = "[...document.querySelectorAll('.scroll')].map(e => e.scrollWidth - e.clientWidth)"
    path = tmp_path / "page.html"
    path.write_text(page + f"<script>document.title = 'hidden: ' + Math.max(...{ask})</script>")
    done = subprocess.run(
        [chromium, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
         f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1200,900", "--dump-dom", path.as_uri()],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert "<title>hidden: 0</title>" in done.stdout
