"""Loose images to captures: order, its proofs, stacks. Images are drawn here, after the formula of the contract."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from fringescope import importing, store
from fringescope.errors import CaptureError, UsageError
from fringescope.importing.evidence import candidates, fit
from fringescope.importing.loose import Gray, Recipe, natural, stack_pages
from fringescope.types import PixelFormat

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/data is absent")
W, H = 300, 200


def scene() -> tuple[Any, Any]:
    """Projector u and v seen by each pixel of a slightly oblique camera."""
    y, x = np.mgrid[0:H, 0:W].astype(float)
    return 60 + 2.4 * x + 0.3 * y + 8 * np.sin(y / 40), 150 + 3.1 * y - 0.2 * x


def fringes(g: tuple[float, float], steps: int, shift: float = 0.0, sense: int = 1, top: int = 255) -> list[Any]:
    u, v = scene()
    rng = np.random.default_rng(int(1e6 * math.hypot(*g)) + steps)
    phi = 2 * np.pi * (g[0] * u + g[1] * v)
    out = []
    for n in range(steps):
        ideal = 0.45 + 0.35 * np.cos(phi - shift - sense * 2 * np.pi * n / steps)
        out.append(np.clip(np.rint(top * (ideal + rng.normal(0, 0.004, ideal.shape))), 0, top))
    return out


def save(folder: Path, images: list[Any], kind: str = "png", dtype: Any = np.uint8) -> None:
    folder.mkdir(exist_ok=True)
    for i, a in enumerate(images):
        cv2.imwrite(str(folder / f"img{i}.{kind}"), a.astype(dtype))


PERIODS = (1140.0, 200.0, 36.0)
STEPS = (4, 4, 8)
RECIPE = Recipe(STEPS, PERIODS)


def sets(**how: Any) -> list[Any]:
    return [f for p, n in zip(PERIODS, STEPS, strict=True) for f in fringes((1 / p, 0.0), n, **how)]


def weigh(folder: Path, recipe: Recipe, **how: Any) -> importing.Evidence:
    (view,) = importing.find_views(folder, recipe, **how)
    return importing.look(view.images, recipe)


def test_natural_order() -> None:
    names = ["frame10.png", "frame2.png", "Frame1.png", "a.png", "frame2b.png"]
    assert sorted(names, key=natural) == ["a.png", "Frame1.png", "frame2.png", "frame2b.png", "frame10.png"]


def test_fit_agrees_with_the_formula() -> None:
    phase, a, b, misfit = fit(np.stack([100 + 50 * np.cos(0.7 - 2 * np.pi * n / 5) for n in range(5)])[:, None])
    assert (float(phase[0]), float(a[0]), float(b[0])) == pytest.approx((0.7, 100, 50))
    assert float(misfit[0]) < 1e-5


def test_candidates_are_all_up_to_rotation_and_reversal() -> None:
    """(N - 1)! / 2 classes: none of them is another one rotated or reversed."""
    for n, count in ((4, 3), (5, 12), (6, 60)):
        seen = set()
        for c in candidates(n):
            turned = [c[k:] + c[:k] for k in range(n)]
            seen.add(min(turned + [t[::-1] for t in turned]))
        assert len(seen) == len(candidates(n)) == count
    assert len(candidates(8)) == len(set(candidates(8)))


def test_a_right_order_is_proved_and_the_capture_holds_it(tmp_path: Path) -> None:
    images = sets()
    save(tmp_path / "in", images)
    (view,) = importing.find_views(tmp_path / "in", RECIPE)
    evidence = importing.look(view.images, RECIPE)
    assert evidence.verdict == "right", evidence.figures()
    assert len(evidence.proved) == 3
    assert max(p.misfit_cycles for p in evidence.pairs) < 0.05
    (tmp_path / "out").mkdir()
    importing.put_import(tmp_path / "out", (view,), RECIPE, {"camera1": evidence})
    assert (tmp_path / "out/import-camera1.png").is_file()
    capture = store.read_capture(tmp_path / "out")
    for (_, a), b in zip(store.view_inputs(capture)[0].frames, images, strict=True):
        np.testing.assert_array_equal(a, b)
    assert capture.extra["imported"]["camera1"]["order"] == "right"


def test_reversed_steps_are_found(tmp_path: Path) -> None:
    save(tmp_path / "in", sets(sense=-1))
    evidence = weigh(tmp_path / "in", RECIPE)
    assert evidence.verdict == "doubtful"
    assert evidence.options == ["--reverse-steps"]
    assert weigh(tmp_path / "in", RECIPE.reversed()).verdict == "right"


@pytest.mark.parametrize("degrees", [90, 180, 270])
@pytest.mark.parametrize("sense", [1, -1])
def test_a_wrong_first_step_is_found(tmp_path: Path, degrees: int, sense: int) -> None:
    save(tmp_path / "in", sets(shift=math.radians(degrees), sense=sense))
    evidence = weigh(tmp_path / "in", RECIPE)
    assert evidence.verdict == "doubtful"
    wanted = f"--first-phase {degrees}" if sense > 0 else f"--reverse-steps --first-phase {degrees}"
    assert evidence.options == [wanted]
    mended = Recipe(STEPS, PERIODS, first_phase_deg=degrees)
    assert weigh(tmp_path / "in", mended if sense > 0 else mended.reversed()).verdict == "right"


def test_a_set_that_runs_backwards_is_found(tmp_path: Path) -> None:
    images = sets()
    save(tmp_path / "in", images[:4] + [images[k] for k in (4, 7, 6, 5)] + images[8:])
    evidence = weigh(tmp_path / "in", RECIPE)
    assert evidence.verdict == "doubtful"
    assert "--reverse-sets 1" in evidence.options
    assert weigh(tmp_path / "in", Recipe(STEPS, PERIODS, reverse=(1,))).verdict == "right"


def test_swapped_steps_are_found(tmp_path: Path) -> None:
    images = [f for p in PERIODS for f in fringes((1 / p, 0.0), 4)]
    save(tmp_path / "in", [images[4 * s + k] for s in range(3) for k in (0, 2, 1, 3)])
    evidence = weigh(tmp_path / "in", Recipe((4,), PERIODS))
    assert evidence.verdict == "doubtful"
    (option,) = evidence.options
    order = tuple(int(k) for k in option.removeprefix("--step-order ").split(","))
    mended = weigh(tmp_path / "in", Recipe((4,), PERIODS, step_order=order))
    assert mended.proved[0].startswith("each set is a sinusoid")


def test_sets_in_another_order_are_found(tmp_path: Path) -> None:
    images = sets()
    save(tmp_path / "in", images[8:] + images[:4] + images[4:8])
    evidence = weigh(tmp_path / "in", Recipe((8, 4, 4), PERIODS))
    assert evidence.verdict == "doubtful"
    assert evidence.options == ["--periods 36,1140,200"]


def test_interleaved_sets_are_found(tmp_path: Path) -> None:
    images = [f for p in PERIODS for f in fringes((1 / p, 0.0), 4)]
    save(tmp_path / "in", [images[4 * s + n] for n in range(4) for s in range(3)])
    evidence = weigh(tmp_path / "in", Recipe((4,), PERIODS))
    assert evidence.verdict == "doubtful"
    assert evidence.options == ["--order interleaved"]
    assert weigh(tmp_path / "in", Recipe((4,), PERIODS, interleaved=True)).verdict == "right"


def test_three_steps_of_one_period_prove_nothing(tmp_path: Path) -> None:
    save(tmp_path / "in", fringes((1 / 36, 0.0), 3))
    evidence = weigh(tmp_path / "in", Recipe((3,), (36.0,)))
    assert evidence.verdict == "open"
    assert "any order" in evidence.notes[-1]


def test_dark_images_are_no_fringes(tmp_path: Path) -> None:
    save(tmp_path / "in", [np.zeros((H, W))] * 4)
    evidence = weigh(tmp_path / "in", Recipe((4,), (36.0,)))
    assert evidence.verdict == "doubtful"
    assert "no modulated pixel" in evidence.against[0]


def gray_images(bits: int, cell: float, inverse: str) -> list[Any]:
    u, _ = scene()
    k = np.floor((u + 0.5) / cell).astype(int)
    code = k ^ (k >> 1)
    plain = [np.where((code >> b) & 1, 200.0, 30.0) for b in range(bits - 1, -1, -1)]
    other = [230.0 - p for p in plain]
    if inverse == "none":
        return [np.full((H, W), 200.0), np.full((H, W), 30.0), *plain]
    return [f for pair in zip(plain, other, strict=True) for f in pair] if inverse == "pairs" else plain + other


@pytest.mark.parametrize("inverse", ["none", "pairs", "after"])
@pytest.mark.parametrize("sense", [1, -1])
def test_gray_code_tells_the_sense(tmp_path: Path, inverse: str, sense: int) -> None:
    images = fringes((0.01, 0.0), 3, sense=sense) + gray_images(4, 100.0, inverse)
    save(tmp_path / "in", images)
    recipe = Recipe((3,), (100.0,), gray=Gray("u", 100.0, 4, inverse, inverse == "none"))
    evidence = weigh(tmp_path / "in", recipe)
    assert evidence.verdict == ("right" if sense > 0 else "doubtful")
    assert evidence.options == ([] if sense > 0 else ["--reverse-steps"])
    if sense > 0:
        (view,) = importing.find_views(tmp_path / "in", recipe)
        (tmp_path / "out").mkdir()
        importing.put_import(tmp_path / "out", (view,), recipe, {"camera1": evidence})
        capture = store.read_capture(tmp_path / "out")
        frames = {(k.role.value, k.number): a for k, a in store.view_inputs(capture)[0].frames if k.set_index == 1}
        np.testing.assert_array_equal(frames["bit", 0], gray_images(4, 100.0, "after")[0])
        if inverse != "none":
            np.testing.assert_array_equal(frames["inverse", 3], gray_images(4, 100.0, "after")[7])


def test_twelve_bits_left_aligned(tmp_path: Path) -> None:
    images = fringes((1 / 36, 0.0), 4, top=4095)
    save(tmp_path / "in", [a * 16 for a in images], dtype=np.uint16)
    recipe = Recipe((4,), (36.0,))
    with pytest.raises(CaptureError, match="left-aligned"):
        weigh(tmp_path / "in", recipe, pixel_format=PixelFormat.MONO12)
    (view,) = importing.find_views(tmp_path / "in", recipe, pixel_format=PixelFormat.MONO12, left_aligned=True)
    np.testing.assert_array_equal(view.images[2], images[2])
    with pytest.raises(UsageError, match="left-aligned"):
        importing.find_views(tmp_path / "in", recipe, left_aligned=True)


def test_other_formats_colours_and_folders_of_cameras(tmp_path: Path) -> None:
    images = fringes((1 / 36, 0.0), 4)
    save(tmp_path / "left", images, "bmp")
    (tmp_path / "right").mkdir()
    for i, a in enumerate(images):
        rgb = np.stack([a, 0.9 * a, 0.5 * a], axis=2).astype(np.uint8)
        cv2.imwrite(str(tmp_path / f"right/img{i}.png"), rgb[..., ::-1])
    left, right = importing.find_views(tmp_path, Recipe((4,), (36.0,)))
    assert (left.camera, left.images.fmt) == ("left", PixelFormat.MONO8)
    assert (right.camera, right.images.fmt) == ("right", PixelFormat.RGB8)
    np.testing.assert_array_equal(left.images[1], images[1])
    np.testing.assert_array_equal(right.images[1][..., 0], images[1])


def test_wrong_counts_and_options(tmp_path: Path) -> None:
    save(tmp_path / "in", fringes((1 / 36, 0.0), 4))
    with pytest.raises(CaptureError, match=r"4 images, --steps and --periods need 8"):
        importing.find_views(tmp_path / "in", Recipe((8,), (36.0,)))
    with pytest.raises(CaptureError, match="no images"):
        importing.find_views(tmp_path / "in", Recipe((4,), (36.0,)), pattern="*.tif")
    with pytest.raises(CaptureError, match="not found"):
        importing.find_views(tmp_path / "nowhere", Recipe((4,), (36.0,)))
    for bad in (
        Recipe((2,), (36.0,)),
        Recipe((4, 4), (36.0, 18.0, 9.0)),
        Recipe((4,), (0.0,)),
        Recipe((4,), (36.0,), step_order=(0, 1, 1, 2)),
        Recipe((4,), (36.0,), first_phase_deg=10),
        Recipe((4, 8), (36.0, 18.0), interleaved=True),
    ):
        with pytest.raises(UsageError):
            bad.order()


# -------------------------------------------------------------------------------------------------------------- stacks


def test_stacks_by_axis_and_time(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    a = rng.integers(0, 60000, (5, 3, 12, 14)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "tz.tif", a, imagej=True, metadata={"axes": "TZYX"})
    tifffile.imwrite(tmp_path / "pages.tif", a.reshape(15, 12, 14), photometric="minisblack")
    images = store.Images(tmp_path)
    for time in (None, 0, 4):
        for stack in (
            stack_pages(tmp_path / "tz.tif", 3, None, time),
            stack_pages(tmp_path / "pages.tif", 3, None, time),
        ):
            got = np.stack([images.frame(n, PixelFormat.MONO16) for n in stack.names])
            np.testing.assert_array_equal(got, a[time or 0])
    for args in ((3, "C", None), (3, None, 5), (3, None, -1)):
        with pytest.raises(UsageError):
            stack_pages(tmp_path / "tz.tif", *args)
    with pytest.raises(CaptureError, match="need 4"):
        stack_pages(tmp_path / "tz.tif", 4, None, None)


@needs_shared
def test_the_real_stack_is_read_along_z() -> None:
    path = SHARED / "stack-16bit" / "ex_stack.tif"
    stack = stack_pages(path, 3, "Z", 7)
    truth = tifffile.imread(path)
    assert truth.shape == (50, 3, 66, 114)
    images = store.Images(path.parent)
    for n in range(3):
        np.testing.assert_array_equal(images.frame(stack.names[n], PixelFormat.MONO16), truth[7, n])


@needs_shared
def test_the_real_mug_needs_the_order_that_its_author_says() -> None:
    """README of the data: the contract's order of each set is 01, 00, 02."""
    how: dict[str, Any] = {"steps": (3,), "periods": (66.6667, 100.0), "projector": (1920, 1080)}
    how["gray"] = Gray("u", 100.0, 5, "pairs")
    assert weigh(SHARED / "gamma-mug/object2", Recipe(**how)).options == ["--reverse-steps"]
    right = Recipe(**how, step_order=(1, 0, 2))
    assert right.order()[:6] == [1, 0, 2, 4, 3, 5]
    assert weigh(SHARED / "gamma-mug/object2", right).verdict == "right"
    turned = Recipe(**how, reverse=(0, 1), first_phase_deg=120)
    assert turned.order() == right.order()
