"""Raw pictures to linear light: the right channel at the right place, no shift, saturation known."""

import numpy as np
import pytest

from fringescope import fuse
from fringescope.errors import CaptureError
from fringescope.settings import FuseSettings
from fringescope.types import Photo, PixelFormat
from tests.reference.colour import de2000, lab


def mosaic(rgb):
    """RGGB samples of a picture (H, W, 3)."""
    raw = rgb[..., 1].copy()
    raw[0::2, 0::2], raw[1::2, 1::2] = rgb[0::2, 0::2, 0], rgb[1::2, 1::2, 2]
    return raw


@pytest.mark.parametrize(
    ("fmt", "full"), [(PixelFormat.BAYER_RG8, 255), (PixelFormat.BAYER_RG12, 4095), (PixelFormat.BAYER_RG16, 65535)]
)
def test_bayer_colours_come_out_in_their_channels(fmt, full):
    colour = np.array([0.6, 0.3, 0.1])
    raw = mosaic(np.broadcast_to(np.rint(colour * full), (20, 24, 3))).astype(fmt.dtype)
    p = fuse.photo(raw, fmt, "camera1")
    np.testing.assert_allclose(p.rgb, np.broadcast_to(colour, p.rgb.shape), atol=0.6 / full)
    assert not p.saturated.any()


def test_demosaicing_does_not_shift():
    v, u = np.mgrid[:40, :50].astype(float)
    ramp = 10_000 + 300 * u + 200 * v
    p = fuse.photo(mosaic(np.repeat(ramp[..., None], 3, 2)).astype(np.uint16), PixelFormat.BAYER_RG16, "camera1")
    inner = p.rgb[4:-4, 4:-4] * 65535 - ramp[4:-4, 4:-4, None]
    assert np.abs(inner).max() < 60, "a fifth of one pixel of the ramp"
    assert abs(inner.mean()) < 5


def test_saturation_marks_every_pixel_that_it_reaches():
    raw = np.full((12, 12), 100, np.uint8)
    raw[6, 6] = 255
    p = fuse.photo(raw, PixelFormat.BAYER_RG8, "camera1")
    touched = (np.abs(p.rgb - 100 / 255) > 1e-3).any(2)
    assert (p.saturated | ~touched).all()
    assert p.saturated.sum() == 9
    rgb = np.zeros((5, 5, 3), np.uint8)
    rgb[2, 2, 1] = 255
    assert fuse.photo(rgb, PixelFormat.RGB8, "camera1").saturated.sum() == 1


def test_mono_is_grey_and_white_balance_acts_on_colour_only():
    s = FuseSettings(white_red=2.0, white_blue=0.5)
    raw = np.full((6, 6), 1000, np.uint16)
    grey = fuse.photo(raw, PixelFormat.MONO12, "camera1", s)
    np.testing.assert_allclose(grey.rgb, 1000 / 4095, rtol=1e-6)
    colour = fuse.photo(np.full((6, 6, 3), 100, np.uint8), PixelFormat.RGB8, "camera1", s)
    np.testing.assert_allclose(colour.rgb[0, 0], np.array([200, 100, 50]) / 255, rtol=1e-6)


def test_white_gains_make_white_white():
    rgb = np.broadcast_to(np.float32([0.2, 0.4, 0.3]), (30, 30, 3)).copy()
    saturated = np.zeros((30, 30), bool)
    saturated[:3] = True
    rgb[:3] = 1
    red, blue = fuse.white_gains(Photo("camera1", rgb, saturated))
    np.testing.assert_allclose([red, blue], [2.0, 4 / 3], rtol=1e-6)
    with pytest.raises(CaptureError, match="expose less"):
        fuse.white_gains(Photo("camera1", rgb, np.ones((30, 30), bool)))
    with pytest.raises(CaptureError, match="black"):
        fuse.white_gains(Photo("camera1", np.zeros_like(rgb), np.zeros((30, 30), bool)))


def test_a_background_serves_as_picture():
    colour = np.array([120.0, 80.0, 40.0])
    A = mosaic(np.broadcast_to(colour, (20, 20, 3))).astype(np.float32)
    A[3, 3] = np.nan
    p = fuse.photo_from_background(A, PixelFormat.BAYER_RG8, "camera1")
    np.testing.assert_allclose(p.rgb[10:, 10:], np.broadcast_to(colour / 255, (10, 10, 3)), atol=1e-4)
    assert np.isfinite(p.rgb).all()
    assert fuse.photo_from_background(np.full((9, 9), 255, np.float32), PixelFormat.MONO8, "camera1").saturated.all()


@pytest.mark.parametrize(
    ("raw", "fmt"),
    [
        (np.zeros((8, 8, 3), np.uint8), PixelFormat.BAYER_RG8),
        (np.zeros((8, 8), np.uint8), PixelFormat.RGB8),
        (np.zeros((2, 8), np.uint8), PixelFormat.BAYER_RG8),
    ],
)
def test_wrong_shapes_are_named(raw, fmt):
    with pytest.raises(CaptureError, match=r"camera 'camera9': (a picture of|8 x 2 pixels)"):
        fuse.photo(raw, fmt, "camera9")


def test_srgb_is_the_standards_curve():
    codes = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(fuse.encode_srgb(fuse.decode_srgb(codes)), codes)
    assert fuse.encode_srgb(np.array([0.2158605, -1.0, 2.0, np.nan])).tolist() == [128, 0, 255, 0]
    np.testing.assert_allclose(
        fuse.decode_srgb(np.array([10, 188], np.uint8)),
        [10 / 255 / 12.92, ((188 / 255 + 0.055) / 1.055) ** 2.4],
        rtol=1e-6,
    )


def test_the_colour_difference_that_judges_us_meets_the_published_pairs():
    """Rows 1, 7, 9, 17, 19, 25 and 34 of the data that go with Sharma, Wu and Dalal 2005."""
    pairs = [
        ((50, 2.6772, -79.7751), (50, 0, -82.7485), 2.0425),
        ((50, 0, 0), (50, -1, 2), 2.3669),
        ((50, 2.49, -0.001), (50, -2.49, 0.0009), 7.1792),
        ((50, 2.5, 0), (73, 25, -18), 27.1492),
        ((50, 2.5, 0), (58, 24, 15), 19.4535),
        ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
        ((2.0776, 0.0795, -1.1350), (0.9033, -0.0636, -0.5514), 0.9082),
    ]
    for a, b, want in pairs:
        assert de2000(a, b) == pytest.approx(want, abs=1e-4)
    np.testing.assert_allclose(lab([255, 255, 255]), [100, 0, 0], atol=0.02)
