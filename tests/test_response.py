"""The response: analytic truth for the harmonics, brute-force fringes for the estimates, the twin and real captures."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from fringescope import capture, denoise, patterns, phase, pipeline, response, store, triangulate
from fringescope.cli import run
from fringescope.devices import simulated
from fringescope.errors import CaptureError, EmptyResultError, FormatError, UsageError
from fringescope.importing import find_views
from fringescope.importing.loose import Recipe
from fringescope.kernels import response as kernel
from fringescope.settings import PatternSettings, ResponseSettings, Settings
from fringescope.twin import presets, scene
from fringescope.types import (
    Decoded,
    FrameKey,
    FringeSet,
    Grid,
    Layout,
    PixelFormat,
    Response,
    Rig,
    Role,
    ViewInput,
    ViewPlan,
)
from tests.reference import response as twin

S = Settings()
SMALL = ResponseSettings(max_pixels=8000)
Curve = Callable[[np.ndarray], np.ndarray]


def linear(x: np.ndarray) -> np.ndarray:
    return x


def power(gamma: float) -> Curve:
    return lambda x: np.asarray(x**gamma)


def draw(
    sets: list[tuple[tuple[float, float], int]],
    curve: Curve = linear,
    *,
    noise: float = 0.6,
    exponents: tuple[float, ...] = (),
    seed: int = 5,
    fmt: PixelFormat = PixelFormat.MONO8,
    bright: float = 190.0,
    size: tuple[int, int] = (160, 240),
) -> ViewInput:
    """Frames of a curved, textured surface under fringes that a response has bent."""
    rng = np.random.default_rng(seed)
    H, W = size
    y, x = np.mgrid[0:H, 0:W].astype(float)
    u = 40 + 2.9 * x + 0.004 * (x - 90) ** 2 + 6 * np.sin(y / 37)
    v = 30 + 3.1 * y + 5 * np.sin(x / 51)
    albedo = 0.75 + 0.25 * cv2.GaussianBlur(rng.uniform(-1, 1, (H, W)), (0, 0), 3) / 0.1
    albedo = np.clip(albedo, 0.25, 1.0) * (fmt.max_value / 255)
    frames = []
    for i, (g, steps) in enumerate(sets):
        for n in range(steps):
            theta = 2 * np.pi * (g[0] * u + g[1] * v) - 2 * np.pi * n / steps
            asked = np.clip(0.5 + 0.5 * np.cos(theta), 0, 1) ** (exponents[i] if exponents else 1.0)
            light = albedo * (10 + bright * curve(asked)) + rng.normal(0, noise * fmt.max_value / 255, (H, W))
            code = np.clip(np.rint(light), 0, fmt.max_value).astype(fmt.dtype)
            frames.append((FrameKey(i, Role.STEP, n), code))
    plan = ViewPlan("camera1", fmt, tuple(FringeSet(g, n) for g, n in sets), (912, 640))
    return ViewInput(plan, frames)


def decoded(view: ViewInput, r: Response | None = None) -> Decoded:
    measured = phase.measure(view.frames, view.plan, S.phase)
    return phase.settle_order(response.corrected(measured, r), view.plan, S.phase)


THREE = [((1 / 920, 0.0), 3), ((1 / 150, 0.0), 3), ((1 / 40, 0.0), 3)]


# ----------------------------------------------------------------------------------------------------------- the model


@pytest.mark.parametrize("gamma", [0.6, 1.0, 1.645, 2.2, 3.0])
def test_harmonics_of_a_power_law_are_the_known_product(gamma: float) -> None:
    h, known = response.gamma_harmonics(gamma), 1.0
    for k in range(2, 8):  # cosine series of ((1 + cos) / 2)^gamma
        known *= (gamma - k + 1) / (gamma + k)
        assert h[k - 2] == pytest.approx(known, abs=2e-4)


@pytest.mark.parametrize("steps", [3, 4, 5, 8])
@pytest.mark.parametrize("gamma", [0.7, 1.6, 2.2])
def test_phase_error_is_that_of_fringes_through_the_curve(steps: int, gamma: float) -> None:
    phi = np.linspace(0, 2 * math.pi, 97)
    n = np.arange(steps)
    seen = (0.5 + 0.5 * np.cos(phi[:, None] - 2 * np.pi * n / steps)) ** gamma
    measured = np.angle(seen @ np.exp(2j * np.pi * n / steps))
    error = np.angle(np.exp(1j * (measured - phi)))
    np.testing.assert_allclose(response.phase_error(response.gamma_harmonics(gamma), steps, phi), error, atol=3e-4)


@pytest.mark.parametrize("steps", [3, 4])
def test_the_table_takes_the_error_back(steps: int) -> None:
    h = response.gamma_harmonics(2.5)
    phi = np.linspace(-3.1, 3.1, 500)
    add, slope = response.table(h, steps)
    seen = (phi + response.phase_error(h, steps, phi)).astype(np.float32)[None]
    out, sigma = np.empty_like(seen), np.empty_like(seen)
    kernel.correct(seen, np.full_like(seen, 0.01), steps, add, slope, out, sigma)
    assert np.abs(np.angle(np.exp(1j * (out[0] - phi)))).max() < 1e-4
    numeric = np.gradient(phi, seen[0])
    np.testing.assert_allclose(sigma[0, 5:-5] / 0.01, numeric[5:-5], rtol=0.02)


def test_kernel_and_its_twin_agree(rng: np.random.Generator) -> None:
    p = rng.uniform(-math.pi, math.pi, (30, 7)).astype(np.float32)
    p[3, 2], p[0, 0], p[1, 1] = np.nan, np.float32(math.pi), np.float32(-math.pi + 1e-6)
    sigma = rng.uniform(0.01, 0.1, p.shape).astype(np.float32)
    add, slope = response.table(response.gamma_harmonics(2.2), 3, 64)
    out, out_sigma = np.empty_like(p), np.empty_like(p)
    kernel.correct(p, sigma, 3, add, slope, out, out_sigma)
    a, b = twin.correct(p, sigma, 3, add, slope)
    turn = np.angle(np.exp(1j * (out - a).astype(np.float64)))
    assert np.nanmax(np.abs(turn)) < 3e-6
    assert np.isnan(out[3, 2])
    assert np.nanmax(np.abs(out)) <= np.float32(math.pi)
    np.testing.assert_allclose(out_sigma[np.isfinite(p)], b[np.isfinite(p)], rtol=2e-5)


def test_predistortion_makes_a_projector_linear() -> None:
    h = response.gamma_harmonics(2.2)
    r = Response("staircase", 2.2, 0.01, tuple(h), tuple(np.zeros(len(h))), needed=True)
    sent = response.predistortion(r)
    assert sent.dtype == np.uint8
    assert sent.shape == (256,)
    light = (sent / 255.0) ** 2.2
    assert np.abs(light - np.arange(256) / 255).max() < 0.008  # a level is 0.9 % of the light at the bright end
    x = np.linspace(0, 1, 11)
    np.testing.assert_allclose(response.inverse_curve(r, response.curve(r, x)), x, atol=2e-3)


def test_fringes_drawn_to_the_inverse_power_are_straight() -> None:
    h = response.gamma_harmonics(2.0)
    r = Response("staircase", 2.0, 0.01, tuple(h), tuple(np.zeros(len(h))))
    straight = response.drawn_to_power(r, 0.5)
    assert max(map(abs, straight.harmonics[:6])) < 2e-3
    assert straight.error_rad[3] < 3e-3
    bent = response.drawn_to_power(r, 2.0)
    np.testing.assert_allclose(bent.harmonics[:5], response.gamma_harmonics(4.0)[:5], atol=2e-3)


# ------------------------------------------------------------------------------------------------- from the own fringes


@pytest.mark.parametrize(
    "gamma", [pytest.param(0.75, marks=pytest.mark.verify), 1.6, pytest.param(2.4, marks=pytest.mark.verify)]
)
def test_three_step_sets_that_must_agree_tell_the_response(gamma: float) -> None:
    view = draw(THREE, power(gamma))
    r = response.from_sets(decoded(view), SMALL)
    h = response.gamma_harmonics(gamma)
    assert r.needed
    assert r.gamma == pytest.approx(gamma, abs=0.06)
    assert r.harmonics[0] == pytest.approx(h[0], abs=0.006)
    assert abs(r.error_rad[3] - response.greatest_error(h, 3)) < max(0.006, 4 * r.error_sigma[3])
    before, after = (np.abs(response.plane_ripple(decoded(view, x)).amplitude) for x in (None, r))
    assert after < 0.1 * before


def test_a_linear_response_is_left_alone() -> None:
    for seed in range(4):
        view = draw(THREE, linear, noise=1.5, seed=seed)
        d = decoded(view)
        r = response.from_sets(d, SMALL)
        assert not r.needed
        assert any("needs no correction" in w for w in r.words)
        assert r.error_rad[3] < 0.004
        assert response.corrected(d, r) is d


def test_more_steps_show_their_harmonics() -> None:
    view = draw([((1 / 60, 0.0), 6)], power(1.8), size=(120, 200))
    measured = phase.measure(view.frames, view.plan, S.phase)
    r = response.from_fringes(measured, view.frames, view.plan, SMALL)
    assert r.source == "fringes"
    h = response.gamma_harmonics(1.8)
    assert r.harmonics[0] == pytest.approx(h[0], abs=0.004)
    assert r.harmonics[1] == pytest.approx(h[1], abs=0.004)
    assert not r.needed  # six steps do not mind
    four = draw([((1 / 60, 0.0), 4)], power(2.4), size=(120, 200))
    measured = phase.measure(four.frames, four.plan, S.phase)
    r = response.from_fringes(measured, four.frames, four.plan, SMALL)
    assert r.harmonics[0] == pytest.approx(response.gamma_harmonics(2.4)[0], abs=0.01)


def test_one_set_of_three_steps_on_something_smooth() -> None:
    view = draw([((1 / 60, 0.0), 3)], power(1.6), size=(160, 240), noise=0.8)
    measured = phase.measure(view.frames, view.plan, S.phase)
    r = response.from_sets(measured, SMALL)
    assert r.figures["smooth_surface_assumed"]
    assert r.error_rad[3] == pytest.approx(response.greatest_error(response.gamma_harmonics(1.6), 3), abs=0.015)


def test_drawings_to_known_powers_tell_the_response() -> None:
    sets = [((1 / 60, 0.0), 3), ((1 / 60, 0.0), 3)]
    view = draw(sets, power(1.7), exponents=(1.3333, 0.8))
    measured = phase.measure(view.frames, view.plan, S.phase)
    r = response.from_exponents(measured, (1.3333, 0.8), SMALL)
    assert r.error_rad[3] == pytest.approx(response.greatest_error(response.gamma_harmonics(1.7), 3), abs=0.01)
    with pytest.raises(UsageError, match="all the same"):
        response.from_exponents(measured, (1.0, 1.0), SMALL)
    with pytest.raises(UsageError, match="one of"):
        response.from_exponents(measured, (1.3,), SMALL)


def test_wrong_orders_and_two_directions_do_not_mislead(rng: np.random.Generator) -> None:
    sets = [((1 / 920, 0.0), 3), ((1 / 50, 0.0), 3), ((0.0, 1 / 660), 3), ((0.0, 1 / 45), 3)]
    d = decoded(draw(sets, power(2.0)))
    wrong = rng.uniform(size=d.shape) < 0.06
    first = replace(d.directions[0], phase=np.where(wrong, d.directions[0].phase + 2 * np.pi, d.directions[0].phase))
    r = response.from_sets(replace(d, directions=(first, *d.directions[1:])), SMALL)
    assert r.needed
    assert r.harmonics[0] == pytest.approx(response.gamma_harmonics(2.0)[0], abs=0.01)


def test_noise_alone_is_no_evidence() -> None:
    d = decoded(draw([((1 / 920, 0.0), 3), ((1 / 100, 0.0), 3)], linear, noise=4.0, bright=60.0, size=(60, 120)))
    r = response.from_sets(d, replace(SMALL, max_sigma_rad=0.4))
    assert not r.needed


@pytest.mark.parametrize("fmt", [PixelFormat.MONO8, PixelFormat.MONO12])
def test_saturation_is_said(fmt: PixelFormat) -> None:
    d = decoded(draw(THREE, power(1.5), bright=330.0, fmt=fmt))
    r = response.from_sets(d, SMALL)
    assert r.saturated > 0.2
    assert any("halve the exposure" in w for w in r.words)


def test_a_bright_end_that_is_flat_is_said() -> None:
    d = decoded(draw(THREE, lambda x: np.minimum(x, 0.72)))
    r = response.from_sets(d, SMALL)
    assert r.needed
    assert any("the bright end is flat" in w for w in r.words)
    assert not any("flat" in w for w in response.from_sets(decoded(draw(THREE, power(0.7))), SMALL).words)


def test_too_little_to_tell_is_an_error() -> None:
    with pytest.raises(EmptyResultError, match="pixels have clean fringes"):
        response.from_sets(decoded(draw(THREE, bright=3.0)), SMALL)
    far = draw(THREE, bright=2000.0)
    with pytest.raises(EmptyResultError, match="halve the exposure"):
        response.from_sets(decoded(far), SMALL)


# ------------------------------------------------------------------------------------------------------- the staircase


def stairs(gamma: float, rng: np.random.Generator, bright: float = 200.0, levels: int = 18) -> tuple[np.ndarray, ...]:
    asked = np.linspace(0, 255, levels)
    gain, offset = rng.uniform(0.3, 1.0, 3000), rng.uniform(2, 12, 3000)
    seen = offset + gain * bright * (asked[:, None] / 255) ** gamma + rng.normal(0, 0.7, (levels, 3000))
    return asked, np.clip(np.rint(seen), 0, 255)


@pytest.mark.parametrize("gamma", [1.0, 1.8, 2.2])
def test_staircase(gamma: float, rng: np.random.Generator) -> None:
    r = response.from_staircase(*stairs(gamma, rng), ResponseSettings())
    assert r.gamma == pytest.approx(gamma, abs=0.01)
    np.testing.assert_allclose(r.harmonics[:3], response.gamma_harmonics(gamma)[:3], atol=0.004)
    assert r.needed == (gamma != 1.0)
    light = (response.predistortion(r) / 255.0) ** gamma
    assert np.abs(light - np.arange(256) / 255).max() < 0.015


def test_staircase_that_saturates_or_does_not_fit(rng: np.random.Generator) -> None:
    asked, seen = stairs(1.8, rng, bright=400.0)
    r = response.from_staircase(asked, seen, ResponseSettings())  # the dim pixels still tell
    assert r.gamma == pytest.approx(1.8, abs=0.02)
    assert any("halve the exposure" in w for w in r.words)
    with pytest.raises(EmptyResultError, match="halve the exposure"):
        response.from_staircase(*stairs(1.8, rng, bright=3000.0), ResponseSettings())
    with pytest.raises(EmptyResultError, match="more light"):
        response.from_staircase(asked, np.full((18, 3000), 3.0), ResponseSettings())
    with pytest.raises(UsageError, match="five or more"):
        response.from_staircase([0, 10, 20], seen[:3], ResponseSettings())
    with pytest.raises(CaptureError, match="needed"):
        response.from_staircase(asked, seen[:-1], ResponseSettings())


# ------------------------------------------------------------------------------------------------------------ the twin


def twin_view(
    gamma: float, steps: tuple[int, int], preset: str = "single", electrons: float = 1.0
) -> tuple[ViewInput, Rig]:
    """A plane under the simulated instrument, whose projector has a gamma."""
    instrument = presets.instrument(preset, 0.05)
    instrument = replace(
        instrument,
        projector=replace(instrument.projector, gamma=gamma),
        electrons=instrument.electrons * electrons,
    )
    world = simulated.World(scene.make("plane", 3), instrument, 3)
    s = PatternSettings(coarse_steps=steps[0], finest_steps=steps[1])
    with simulated.station(world) as station:
        formats = {c.name: c.settings.pixel_format for c in station.cameras}
        plan = patterns.plan(station.rig, formats, s).views[0]
        images = patterns.images(plan, station.rig.projector, s)
        frames = list(capture.stream(station.projector, station.cameras[0], images, plan))
        return ViewInput(plan, frames), station.rig


def scanned(view: ViewInput, rig: Rig, r: Response | None) -> tuple[Decoded, Grid]:
    measured = phase.measure(view.frames, view.plan, S.phase)
    d = phase.settle_order(response.corrected(measured, r), view.plan, S.phase, rig, S.denoise.volume_margin)
    reasons = denoise.exposed(d, view.plan.pixel_format, S.denoise)
    return d, triangulate.grid(d, reasons, rig, volume_margin=S.denoise.volume_margin)


def ripple_um(d: Decoded, grid: Grid) -> float:
    """Amplitude of the points' distance from their plane at three waves per fringe, um."""
    p, phi = grid.xyz[grid.valid].astype(np.float64), d.directions[0].phase[grid.valid].astype(np.float64)
    middle = p.mean(0)
    normal = np.linalg.svd(p[::5] - middle, full_matrices=False)[2][2]
    A = np.column_stack([np.ones(len(p)), p[:, 0], p[:, 1], np.sin(3 * phi), np.cos(3 * phi)])
    c = np.linalg.lstsq(A, 1000 * (p - middle) @ normal, rcond=None)[0]
    return float(np.hypot(c[3], c[4]))


# 12 bits mono, 8 bits Bayer
@pytest.mark.parametrize("preset", ["single", pytest.param("pair", marks=pytest.mark.verify)])
def test_the_twins_ripple_goes(preset: str) -> None:
    view, rig = twin_view(1.6, (3, 3), preset)
    d, grid = scanned(view, rig, None)
    r = response.from_sets(d, SMALL, (8 / 255, 247 / 255))
    assert r.needed
    assert r.gamma == pytest.approx(1.6, abs=0.04)
    before, after = ripple_um(d, grid), ripple_um(*scanned(view, rig, r))
    assert before > 30
    assert after <= before / 10


def test_harmonics_are_no_noise() -> None:
    view, rig = twin_view(1.6, (4, 4))
    d, _ = scanned(view, rig, None)
    straight, _ = scanned(*twin_view(1.0, (4, 4)), None)
    A = np.float32([np.median(straight.background)])
    assert d.noise.variance(A)[0] > 20 * straight.noise.variance(A)[0]  # every pixel looks noisy
    r = response.from_fringes(d, view.frames, view.plan, SMALL, (8 / 255, 247 / 255))
    mended, grid = scanned(view, rig, r)
    assert grid.valid.mean() > 0.5
    assert mended.noise.variance(A)[0] == pytest.approx(straight.noise.variance(A)[0], rel=0.8)
    assert np.median(mended.sets[-1].sigma) < 2 * np.median(straight.sets[-1].sigma)
    assert response.corrected(straight, r).noise.variance(A)[0] <= 1.01 * straight.noise.variance(A)[0]


@pytest.mark.parametrize("steps", [4, 5, 8])
def test_power_beside_the_fringe_is_that_of_a_fit(steps: int) -> None:
    h, phi = response.gamma_harmonics(2.0), np.linspace(0, 6, 7)
    theta = phi[:, None] - 2 * np.pi * np.arange(steps) / steps
    light = (0.5 + 0.5 * np.cos(theta)) ** 2.0
    amplitude = 0.5  # ((1 + cos) / 2)^2 = 3/8 + cos / 2 + cos 2 / 8
    design = np.column_stack([np.ones(steps), np.cos(2 * np.pi * np.arange(steps) / steps),
                              np.sin(2 * np.pi * np.arange(steps) / steps)])  # fmt: skip
    left = [np.linalg.lstsq(design, row, rcond=None)[1].sum() / (steps - 3) for row in light]
    np.testing.assert_allclose(response.residual_power(h, steps, phi), np.array(left) / amplitude**2, atol=2e-6)


def test_the_linear_twin_needs_nothing_and_a_blown_one_is_told() -> None:
    view, rig = twin_view(1.0, (3, 3))
    d, _ = scanned(view, rig, None)
    r = response.from_sets(d, SMALL)
    assert not r.needed
    assert any(w.startswith("needs no correction") for w in r.words)
    view, rig = twin_view(1.6, (3, 3), electrons=1.6)
    d, _ = scanned(view, rig, None)
    r = response.from_sets(d, SMALL)
    assert any("halve the exposure" in w for w in r.words)


# ----------------------------------------------------------------------------------------------------------- real ones


def disagreement(d: Decoded) -> float:
    """Median disagreement of the mug's two frequencies, projector pixels."""
    fine, coarse = sorted(d.sets, key=lambda w: -w.g[0])
    u = d.directions[0].phase / (2 * np.pi * fine.g[0])
    turns = coarse.phase / (2 * np.pi)
    again = (turns + np.rint(u * coarse.g[0] - turns)) / coarse.g[0]
    reasons = denoise.exposed(d, PixelFormat.MONO8, S.denoise)
    return float(np.median(np.abs(u - again)[reasons == 0]))


def test_the_mugs_two_frequencies_agree_after_a_correction_learnt_from_themselves(shared: Path) -> None:
    view = store.view_inputs(store.read_capture(shared / "data" / "gamma-mug" / "object2"))[0]
    d = decoded(view)
    assert 3.5 <= disagreement(d) <= 4.8
    r = response.from_sets(d, SMALL)
    assert r.needed
    assert r.figures["pairs"][0]["median_before"] == pytest.approx(4.2, abs=0.3)
    assert disagreement(decoded(view, r)) <= 0.6
    assert disagreement(pipeline.decode_view(view, S)) > 3
    assert disagreement(pipeline.decode_view(replace(view, response=r), S)) <= 0.6


@pytest.mark.verify
def test_the_mugs_plane_tells_the_authors_exponent(shared: Path) -> None:
    recipe = Recipe((3, 3), (240, 240), ((1.0, 0.0), (0.0, 1.0)), (1920, 1080), Layout.GRID, step_order=(1, 0, 2))
    folder = shared / "data" / "gamma-mug"
    plane = find_views(folder / "gamma_correction", recipe, pattern="pat[01]?.png")[0].view_input(recipe)
    measured = phase.measure(plane.frames, plane.plan, S.phase)
    r = response.from_exponents(measured, (1 / 0.75, 1 / 1.25) * 2, SMALL)
    assert r.gamma == pytest.approx(1.645, abs=0.12)  # the author's estimate
    # the objects were drawn to the power that he found
    view = store.view_inputs(store.read_capture(folder / "object2"))[0]
    assert disagreement(decoded(view, response.drawn_to_power(r, 1.645))) <= 0.6


def test_the_documented_commands_free_the_mug(shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                              capsys: pytest.CaptureFixture[str]) -> None:  # fmt: skip
    """docs/response.md, word by word: nothing but the folder with two drawings is looked at."""
    page = (Path(__file__).parents[1] / "docs" / "response.md").read_text()
    lines = [shlex.split(x)[1:] for x in page.splitlines() if x.startswith("    fringescope ")]
    lines = [x for x in lines if x[1] in ("gamma_correction", "object2")]
    assert [x[0] for x in lines] == ["response", "decode"]
    for name in ("gamma_correction", "object2"):
        (tmp_path / name).symlink_to(shared / "data" / "gamma-mug" / name)
    monkeypatch.chdir(tmp_path)
    assert run(lines[0]) == 0
    told = capsys.readouterr().out
    doc = json.loads((tmp_path / "response.json").read_text())
    assert doc["drawn_to_power"] == pytest.approx(1.645, abs=0.12)  # the author's estimate
    assert f"the second harmonic is {100 * doc['harmonics'][0]:.2f}" in told  # the words are of what the file holds
    assert f"{doc['error_rad']['3']:.4f}" in told
    assert f"drawn to the power {doc['drawn_to_power']:.4g}" in told
    view = store.view_inputs(store.read_capture(shared / "data" / "gamma-mug" / "object2"))[0]
    freed = pipeline.decode_view(replace(view, response=store.read_response(tmp_path / "response.json")), S)
    assert disagreement(freed) <= 0.6
    assert run(lines[1]) == 0
    u = tifffile.imread(next((tmp_path / "decoded").glob("*/phase_0.tif")))
    kept = np.isfinite(u)
    assert kept.sum() > 1e6
    np.testing.assert_array_equal(u[kept], freed.directions[0].phase[kept])


def test_words_follow_the_power_that_fringes_are_drawn_to() -> None:
    r = response.from_sets(decoded(draw(THREE, power(2.0))), SMALL)
    assert r.needed
    straight = response.as_drawn(r, 0.5, SMALL)  # 1 / gamma: linear
    assert not straight.needed
    assert "needs no correction" in straight.words[1]
    strong = response.as_drawn(r, 1.5, SMALL)
    assert strong.needed
    assert strong.gamma == pytest.approx(3.0, rel=0.03)
    np.testing.assert_allclose(strong.harmonics[:3], response.gamma_harmonics(3.0)[:3], atol=0.01)
    assert f"{100 * strong.harmonics[0]:.2f}" in strong.words[0]
    assert strong.sigmas[0] > 0
    assert strong.error_sigma[3] > 0


def test_the_skull_is_left_alone(shared: Path) -> None:
    view = store.view_inputs(store.read_capture(shared / "data" / "slstudio" / "skull"))[0]
    rig = store.read_rig(shared / "data" / "slstudio" / "rig-author.json")
    measured = phase.measure(view.frames, view.plan, S.phase)
    d = phase.settle_order(measured, view.plan, S.phase, rig)
    r = response.from_sets(d, SMALL)
    assert not r.needed
    assert response.corrected(measured, r) is measured


# --------------------------------------------------------------------------------------------------- file and command


def test_a_response_survives_its_file(tmp_path: Path) -> None:
    sigmas, levels = (0.001, 0.001), (0.03, 0.97)
    r = Response("sets", 1.6, 0.01, (0.15, -0.01), sigmas, 1.2, levels, {3: 0.15}, {3: 0.001}, 9, 0.0, True)
    path = tmp_path / "response.json"
    store.write_json(path, store.response_document(r, response.predistortion(r).tolist()))
    assert store.read_response(path) == r
    doc = json.loads(path.read_text())
    bad = {"version": 2}, {"format": "x"}, {"harmonics": []}, {"gamma": -1.0}, {"sigmas": [0.1]}, {"needed": 3}
    for change in bad:
        path.write_text(json.dumps(doc | change))
        with pytest.raises(FormatError):
            store.read_response(path)


def write_frames(folder: Path, view: ViewInput) -> None:
    folder.mkdir()
    for i, (_, frame) in enumerate(view.frames):
        cv2.imwrite(str(folder / f"{i:02d}.png"), frame)


def test_command_on_loose_fringes_and_a_capture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    view = draw(THREE, power(2.0))
    write_frames(tmp_path / "loose", view)
    out = tmp_path / "response.json"
    line = ["response", str(tmp_path / "loose"), "--steps", "3,3,3", "--periods", "920,150,40", "--out", str(out)]
    assert run([*line, "--report", str(tmp_path / "r.png"), "--json"]) == 0
    doc = json.loads(capsys.readouterr().out)
    assert doc["needed"]
    assert doc["gamma"] == pytest.approx(2.0, abs=0.06)
    assert len(doc["predistortion"]) == 256
    assert cv2.imread(str(tmp_path / "r.png")).shape[1] > 800
    assert store.read_response(out).needed
    assert run(line) == 1  # it exists
    assert "--force" in capsys.readouterr().err

    store.write_capture(tmp_path / "capture", 912, 640, Layout.GRID, [view])
    assert run(["response", str(tmp_path / "capture"), "--out", str(tmp_path / "b.json")]) == 0
    assert "needs correction" in capsys.readouterr().out
    phases = []
    for name, extra in (("plain", []), ("freed", ["--response", str(out)])):
        assert run(["decode", str(tmp_path / "capture"), "--out", str(tmp_path / name), *extra]) == 0
        phases.append(tifffile.imread(tmp_path / name / view.plan.camera / "phase_0.tif"))
    moved = np.abs(phases[1] - phases[0])
    greatest = math.asin(0.25)  # ((1 + cos) / 2)^2 is cos + cos 2 / 4 and a constant; three steps see cos 2 backwards
    assert np.nanpercentile(moved, 99.5) == pytest.approx(greatest, rel=0.1)
    capsys.readouterr()
    line = ["decode", str(tmp_path / "capture"), "--out", str(tmp_path / "no"), "--response"]
    assert run([*line, str(tmp_path / "nowhere.json")]) == 1
    assert "nowhere.json" in capsys.readouterr().err
    assert not (tmp_path / "no").exists()


def test_command_on_a_staircase(tmp_path: Path, capsys: pytest.CaptureFixture[str], rng: np.random.Generator) -> None:
    asked, seen = stairs(2.0, rng, levels=9)
    (tmp_path / "s").mkdir()
    for i, row in enumerate(seen):
        cv2.imwrite(str(tmp_path / "s" / f"{i}.png"), row.reshape(50, 60).astype(np.uint8))
    out = str(tmp_path / "r.json")
    assert run(["response", str(tmp_path / "s"), "--staircase", "9", "--out", out]) == 0
    assert "gamma 2.0" in capsys.readouterr().out
    levels = ",".join(f"{x:g}" for x in asked)
    assert run(["response", str(tmp_path / "s"), "--staircase", levels, "--out", out, "--force"]) == 0


@pytest.mark.parametrize(
    ("options", "status", "word"),
    [
        (["--staircase", "7"], 1, "images for 7 levels"),
        (["--staircase", "3"], 2, "five or more"),
        ([], 2, "--staircase"),
        (["--staircase", "9", "--exponents", "1,2"], 2, "one of them"),
        (["--levels", "9"], 2, "--levels"),
        (["--drawn", "0"], 2, "--drawn"),
        (["--drawn", "found"], 2, "--drawn"),
    ],
)
def test_command_says_what_is_wrong(
    options: list[str], status: int, word: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "s").mkdir()
    for i in range(9):
        cv2.imwrite(str(tmp_path / "s" / f"{i}.png"), np.full((20, 20), 20 * i, np.uint8))
    out = tmp_path / "r.json"
    assert run(["response", str(tmp_path / "s"), *options, "--out", str(out)]) == status
    error = capsys.readouterr().err
    assert word in error
    assert len(error.strip().splitlines()) == 1
    assert not out.exists()
