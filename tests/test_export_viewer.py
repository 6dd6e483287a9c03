"""The page that shows a surface: self-contained, and really drawn by a browser where one is installed."""

import json
import re
import shutil
import subprocess
import tempfile

import cv2
import numpy as np
import pytest

from fringescope import export
from fringescope.types import Surface, SurfacePart
from tests.test_export import surface

BROWSER = next((b for b in ("chromium", "chromium-browser", "google-chrome") if shutil.which(b)), None)
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--no-first-run",
    "--hide-scrollbars",
    "--virtual-time-budget=8000",
    "--window-size=640,420",
)


def test_the_page_fetches_nothing_and_escapes_what_it_is_given():
    page = export.viewer_page(surface(), "<b>Tumour & margin</b></script>", "a note")
    assert "default-src 'none'" in page
    assert not re.findall(r"(?:src|href)\s*=\s*[\"']?(?:https?:)?//", page)
    assert "@DATA@" not in page
    assert "@TITLE@" not in page
    assert page.count("</script>") == 2
    assert "<b>Tumour" not in page
    data = json.loads(re.search(r'type="application/json">(.*?)</script>', page, re.S).group(1))
    assert data["title"] == "<b>Tumour & margin</b></script>"
    assert len(data["parts"]) == 2


def shot(page, tmp_path, where=""):
    """What the browser draws, (h, w, 3) RGB."""
    if BROWSER is None:
        pytest.skip("no Chromium is installed: the page cannot be drawn")
    path, picture = tmp_path / "page.html", tmp_path / "shot.png"
    path.write_text(page, encoding="utf-8")
    with tempfile.TemporaryDirectory() as profile:
        done = subprocess.run(
            [
                BROWSER,
                *FLAGS,
                f"--user-data-dir={profile}",
                f"--screenshot={picture}",
                "--enable-logging=stderr",
                f"{path.as_uri()}#{where}",
            ],
            capture_output=True,
            text=True,
            timeout=120,
            check=True,
        )
    assert "CONSOLE" not in done.stderr, [line for line in done.stderr.splitlines() if "CONSOLE" in line][:3]
    return cv2.imread(str(picture))[..., ::-1].astype(int)


def painted(colour):
    s = surface(12, 1)
    texture = np.broadcast_to(np.uint8(colour), (40, 60, 3)).copy()
    texture[:, 30:] = np.uint8(colour)[::-1]  # the half with larger x is painted in the mirrored colour
    p = s.parts[0]
    return Surface(s.vertices, s.normals, (SurfacePart(0, p.vertex_index, p.uv, p.faces, texture),))


def test_the_browser_draws_the_picture_the_right_way_round(tmp_path):
    image = shot(export.viewer_page(painted([220, 60, 20])), tmp_path, "mode=colour&elevation=89")
    red = (abs(image - [220, 60, 20]) < 25).all(2)
    blue = (abs(image - [20, 60, 220]) < 25).all(2)
    assert red.sum() > 5000
    assert blue.sum() > 5000
    assert np.argwhere(red)[:, 1].mean() < np.argwhere(blue)[:, 1].mean() - 50, "x grows to the right, seen from above"


def test_the_other_ways_of_showing_differ(tmp_path):
    page = export.viewer_page(surface(12, 1))
    seen = {
        mode: shot(page, tmp_path, f"mode={mode}&elevation=60")[150:270, 220:420]
        for mode in ("colour", "relief", "height", "views")
    }
    grey = seen["relief"]
    assert np.median(np.ptp(grey, axis=2)) < 30, "relief has no hue to speak of"
    assert grey[..., 0].std() > 5, "and shows the waves"
    modes = list(seen)
    for i, a in enumerate(modes):
        for b in modes[:i]:
            assert abs(seen[a] - seen[b]).mean() > 8


def test_without_webgl_the_page_says_so_and_shows_the_pictures(tmp_path):
    page = export.viewer_page(painted([220, 60, 20])).replace('asked.has("nogl")', "true")
    image = shot(page, tmp_path)
    red = (abs(image - [220, 60, 20]) < 25).all(2)
    assert red.sum() > 500


@pytest.mark.parametrize("R", [np.eye(3), np.diag([1, -1, -1.0]), np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])])
def test_whatever_the_world_the_surface_is_seen_from_outside(R):
    s = surface(12, 1)
    turned = Surface((s.vertices @ R.T).astype(np.float32), (s.normals @ R.T).astype(np.float32), s.parts)
    data = json.loads(re.search(r'json">(.*?)</script>', export.viewer_page(turned), re.S).group(1))
    T = np.array(data["turned"])
    np.testing.assert_allclose(T @ T.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T) == pytest.approx(1)
    assert (turned.normals @ T.T).mean(0)[2] > 0.9
