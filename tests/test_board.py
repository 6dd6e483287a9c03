"""A printed board: true scale, the squares and markers that OpenCV draws, and one clear line where it does not fit."""

import json
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET

import cv2
import numpy as np
import pytest

from fringescope import cli, export
from fringescope.errors import UsageError
from fringescope.types import Board

POINT = 72 / 25.4


def page_of(pdf):
    """Page size in mm, and the dark rectangles (n, 4) in mm from the top left, as the file's operators say."""
    text = pdf.decode("latin-1")
    width, height = (float(x) / POINT for x in re.search(r"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", text).groups())
    numbers = np.array([[float(v) for v in m] for m in re.findall(r"(\S+) (\S+) (\S+) (\S+) re", text)]) / POINT
    x, y, w, h = numbers.T
    return (width, height), np.column_stack([x, height - y - h, w, h])


def raster(rects, size, scale):
    """A picture of the rectangles, `scale` pixels per mm, by coverage on a grid twice as fine."""
    fine = scale * 2
    out = np.full((round(size[1] * fine), round(size[0] * fine)), 255, np.uint8)
    for x, y, w, h in rects:
        a, b, c, d = (round(v * fine) for v in (x, y, x + w, y + h))
        out[b:d, a:c] = 0
    return cv2.resize(out, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def printed(tmp_path, *options, name="board.pdf"):
    out = tmp_path / name
    assert cli.run(["board", "--out", str(out), *options]) == 0
    return out.read_bytes(), json.loads((tmp_path / "board.json").read_text())


def test_the_corners_lie_where_the_description_says(tmp_path):
    pdf, doc = printed(tmp_path, "--squares", "12x9", "--square-mm", "5")
    assert doc == {"pattern": "checkerboard", "inner_corners": [11, 8], "square_mm": 5.0}
    size, rects = page_of(pdf)
    assert size == pytest.approx((297, 210), abs=1e-3)
    picture = raster(rects, size, 10)
    found, corners = cv2.findChessboardCornersSB(picture, (11, 8), flags=cv2.CALIB_CB_ACCURACY)
    assert found
    mm = (corners.reshape(8, 11, 2) + 0.5) / 10
    steps = np.abs(np.diff(mm, axis=1))[..., 0], np.abs(np.diff(mm, axis=0))[..., 1]
    for step in steps:
        assert step == pytest.approx(5.0, abs=0.02)
    assert mm.mean(axis=(0, 1)) == pytest.approx([148.5, 105], abs=0.02)  # in the middle of the page


def test_the_first_square_is_dark_and_half_a_turn_changes_the_picture(tmp_path):
    pdf, doc = printed(tmp_path, "--paper", "A3")
    size, rects = page_of(pdf)
    picture = raster(rects, size, 4)
    big = rects[np.isclose(rects[:, 2:], doc["square_mm"], atol=1e-3).all(axis=1)]
    left, top = big[:, 0].min(), big[:, 1].min()
    right, bottom = (big[:, :2] + big[:, 2:]).max(axis=0)
    board = picture[round(top * 4) : round(bottom * 4), round(left * 4) : round(right * 4)]
    assert board[4, 4] == 0
    assert np.mean(board != board[::-1, ::-1]) > 0.9


@pytest.mark.parametrize(("options", "squares"), [(["--squares", "12x9", "--square-mm", "5"], (12, 9)), ([], (12, 9)),
                                                 (["--paper", "A3", "--square-mm", "12"], None)])  # fmt: skip
def test_markers_are_read_and_lie_as_opencv_lays_them(tmp_path, options, squares):
    pdf, doc = printed(tmp_path, "--pattern", "charuco", *options)
    size, rects = page_of(pdf)
    if squares:
        assert doc["squares"] == list(squares)
    words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, doc["dictionary"]))
    theirs = cv2.aruco.CharucoBoard(tuple(doc["squares"]), doc["square_mm"], doc["marker_mm"], words)
    scale = 10 if doc["square_mm"] < 10 else 4
    corners, ids, _, markers = cv2.aruco.CharucoDetector(theirs).detectBoard(raster(rects, size, scale))
    c, r = doc["squares"]
    assert len(markers) == c * r // 2
    assert len(ids) == (c - 1) * (r - 1)
    mm = (corners.reshape(-1, 2) + 0.5) / scale
    wanted = theirs.getChessboardCorners()[ids.ravel(), :2] + [(size[0] - c * doc["square_mm"]) / 2,
                                                              (size[1] - r * doc["square_mm"]) / 2]  # fmt: skip
    assert np.abs(mm - wanted).max() < 0.1


def test_an_outside_reader_prints_it_at_true_scale(tmp_path):
    if shutil.which("pdftoppm") is None:
        pytest.skip("no pdftoppm here (tools/system_packages.sh installs it)")
    pdf, _ = printed(tmp_path, "--paper", "letter", "--squares", "9x6", "--square-mm", "20")
    subprocess.run(["pdftoppm", "-r", "254", "-gray", tmp_path / "board.pdf", tmp_path / "p"], check=True, timeout=60)
    picture = cv2.imread(str(next(tmp_path.glob("p*.pgm"))), cv2.IMREAD_GRAYSCALE)
    assert picture.shape == pytest.approx((2159, 2794), abs=1)
    found, corners = cv2.findChessboardCornersSB(picture, (8, 5), flags=cv2.CALIB_CB_ACCURACY)
    assert found
    assert np.linalg.norm(corners[0, 0] - corners[7, 0]) == pytest.approx(1400, abs=0.5)
    assert b"/PrintScaling /None" in pdf


def test_the_measuring_bars_are_as_long_as_they_say(tmp_path, capsys):
    pdf, _ = printed(tmp_path, "--squares", "12x9", "--square-mm", "5", "--json")
    told = json.loads(capsys.readouterr().out)
    _, rects = page_of(pdf)
    thin = rects[np.isclose(rects[:, 2:].min(axis=1), 0.15, atol=1e-3)]
    across = thin[np.isclose(thin[:, 2], told["bar_mm"][0], atol=1e-3)]
    down = thin[np.isclose(thin[:, 3], told["bar_mm"][1], atol=1e-3)]
    assert len(across) == len(down) == 1
    ticks = thin[np.isclose(thin[:, 3], 2.4, atol=1e-3)]
    assert np.ptp(ticks[:, 0]) == pytest.approx(told["bar_mm"][0], abs=1e-3)


def test_svg_and_pdf_draw_the_same(tmp_path):
    _, doc = printed(tmp_path, "--pattern", "charuco", name="a.svg")
    root = ET.fromstring((tmp_path / "a.svg").read_text())
    pattern = root.findall("{http://www.w3.org/2000/svg}path")[0].get("d")
    page = export.draw(Board(tuple(doc["squares"]), doc["square_mm"], doc["marker_mm"], doc["dictionary"]), (297, 210))
    moves = np.array(re.findall(r"M(\S+) ([^h]+)h([^v]+)v([^h]+)h", pattern), dtype=float)
    assert moves == pytest.approx(page.pattern, abs=1e-4)
    assert (root.get("width"), root.get("viewBox")) == ("297mm", "0 0 297 210")


def test_ink_is_grey_and_invert_swaps():
    board = Board((12, 9), 5)
    assert "0.6 g\n" in export.pdf_bytes(export.draw(board, (297, 210), ink=0.4)).decode("latin-1")
    plain, swapped = (export.draw(board, (297, 210), invert=i).pattern for i in (False, True))
    assert len(plain) == len(swapped) == 54
    assert not {tuple(r) for r in plain.round(3)} & {tuple(r) for r in swapped.round(3)}


@pytest.mark.parametrize("square", [5, 7.5, 12, 20])
@pytest.mark.parametrize("paper", ["A4", "A3", "letter", "500x120"])
def test_as_many_squares_as_fit_differ_at_their_ends(paper, square):
    board, size = export.best_board(paper, square_mm=square)
    assert board.ends_differ
    assert board.squares[0] * square <= size[0] - 30
    assert board.squares[1] * square <= size[1] - 30


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--squares", "30x20", "--square-mm", "20"], "squares up to 8 mm fit"),
        (["--squares", "2x9"], "3 to 200"),
        (["--squares", "a"], "--squares a"),
        (["--paper", "B9"], "--paper B9"),
        (["--paper", "30x30"], "40 to 5000"),
        (["--paper", "nanx80"], "40 to 5000"),
        (["--square-mm", "nan"], "at least 1"),
        (["--square-mm", "150"], "fewer than 3"),
        (["--pattern", "dots"], "checkerboard or charuco"),
        (["--marker-mm", "3"], "belong to --pattern charuco"),
        (["--pattern", "charuco", "--square-mm", "5", "--marker-mm", "5"], "less than the squares'"),
        (["--pattern", "charuco", "--dictionary", "DICT_9"], "OpenCV's names"),
        (["--pattern", "charuco", "--dictionary", "DICT_4X4_50", "--squares", "20x15"], "needs 150"),
        (["--pattern", "charuco", "--invert"], "dark on white"),
        (["--ink", "0"], "0.1"),
        (["--squares", "200x190"], "smaller than 1 mm"),
    ],
)
def test_what_cannot_be_printed_is_refused_in_one_line(tmp_path, capsys, options, said):
    assert cli.run(["board", "--out", str(tmp_path / "b.pdf"), *options]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert said in lines[0]
    assert not list(tmp_path.iterdir())


def test_nothing_is_replaced_unasked(tmp_path, capsys):
    printed(tmp_path)
    before = (tmp_path / "board.pdf").read_bytes()
    assert cli.run(["board", "--out", str(tmp_path / "other.pdf"), "--paper", "A3"]) == 1  # its board.json is there
    assert not (tmp_path / "other.pdf").exists()
    assert (tmp_path / "board.pdf").read_bytes() == before
    printed(tmp_path, "--force")
    assert (tmp_path / "board.pdf").read_bytes() == before
    assert cli.run(["board", "--out", str(tmp_path / "board.png")]) == 2
    assert ".pdf or .svg" in capsys.readouterr().err


def test_a_board_that_looks_the_same_after_half_a_turn_is_said_so(tmp_path, capsys):
    printed(tmp_path, "--squares", "10x8")
    assert "half a turn" in capsys.readouterr().out


def test_design_of_a_page_is_the_same_each_time():
    board = export.design((297, 210))
    assert export.pdf_bytes(export.draw(board, (297, 210))) == export.pdf_bytes(export.draw(board, (297, 210)))
    with pytest.raises(UsageError, match="ink"):
        export.draw(board, (297, 210), ink=2)
