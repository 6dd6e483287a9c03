"""Every threshold in one typed tree: frozen, with unit, default and paper section; YAML in and out; stored with every scan.

Each field is declared with `knob(default, unit, doc, paper)`; `describe()` lists them all and the docs are made of it.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from fringescope.errors import UsageError


def knob(default: Any, unit: str, doc: str, paper: str = "", low: float | None = None, high: float | None = None) -> Any:
    """A settings field: its default, unit ("" = dimensionless), meaning, paper section and allowed closed range."""
    return field(default=default, metadata={"unit": unit, "doc": doc, "paper": paper, "low": low, "high": high})


def _same_kind(value: Any, default: Any) -> bool:
    """Whether a value may stand where `default` stands: a whole number also where a fraction may, nothing else mixed."""
    if isinstance(default, float):
        return isinstance(value, (int, float)) and not isinstance(value, bool)
    return type(value) is type(default)


class _Section:
    """Checks ranges and types of a section's fields when it is made."""

    def __post_init__(self) -> None:
        for f in dataclasses.fields(self):  # type: ignore[arg-type]
            value, meta = getattr(self, f.name), f.metadata
            if "unit" not in meta:
                continue
            if not _same_kind(value, f.default):
                raise UsageError(f"setting {f.name}: {value!r}; needed a {type(f.default).__name__}")
            if isinstance(value, (int, float)) and not isinstance(value, bool):
                low, high = meta["low"], meta["high"]
                if value != value or (low is not None and value < low) or (high is not None and value > high):
                    lo, hi = "-inf" if low is None else low, "inf" if high is None else high
                    raise UsageError(f"setting {f.name}: {value}; needed {lo} to {hi} {meta['unit']}".rstrip())


@dataclass(frozen=True)
class PhaseSettings(_Section):
    """Frames to absolute phase (II-C)."""

    systematic_rad: float = knob(0.05, "rad", "phase error that noise does not explain (response, defocus); added to sigma when orders are weighed", "II-C", 0, 1)
    order_min_margin: float = knob(3.0, "sigma", "an order is uncertain if the next one fits less than this many standard deviations worse", "II-C", 0)
    unexpected_sigma: float = knob(4.0, "sigma", "what it costs an order to lie beyond 25 % of the working distance, in a rig without a measuring volume", "II-C", 0)
    order_votes: int = knob(5, "pixels", "side of the window in which neighbours vote on a pixel's order; 1 = no vote", "II-C", 1, 31)
    order_majority: float = knob(0.7, "", "share of the votes that repairs an order", "II-C", 0.5, 1)
    max_sigma_rad: float = knob(0.5, "rad", "pixels whose phase is noisier than this do not vote on orders", "II-C", 0)
    max_misfit: float = knob(6.0, "sigma", "N-step samples that miss the fitted sinusoid by more than this are inconsistent frames", "", 0)
    max_saturated: float = knob(0.5, "", "share of a set's samples that may be saturated; they stay out of the fit", "III-D", 0, 1)


@dataclass(frozen=True)
class DenoiseSettings(_Section):
    """The masks of section III-D and the fourth test. Thresholds in codes are given for 8 bits and scale with the depth."""

    min_background: float = knob(3.0, "8-bit codes", "pixels darker than this are dark", "III-D 1", 0)
    min_modulation: float = knob(3.0, "8-bit codes", "pixels modulated less than this have low modulation", "III-D 1", 0)
    min_contrast: float = knob(0.05, "", "least modulation as a share of the background", "V-D", 0, 1)
    min_modulation_sigma: float = knob(4.0, "sigma", "least modulation in standard deviations of a sample at that background", "V-D", 0)
    max_sigma_rad: float = knob(0.033, "rad", "a phase noisier than this is of no use, unless the whole view is noisy", "V-D", 0)
    max_sigma_factor: float = knob(2.2, "", "a phase noisier than this times the view's median is of no use if it is above max_sigma_rad", "V-D", 1)
    min_fine_modulation: float = knob(0.8, "", "least modulation of the finest set over the next coarser one, relative to what is usual around: less means light that came by way of other places", "III-D 1", 0, 1)
    monotonic_reach: float = knob(2.0, "pixels of 684", "distance over which the phase gradient is taken, at 684 pixels of image width", "III-D 2", 1)
    monotonic_sigma: float = knob(3.0, "sigma", "a gradient has a sign if it exceeds this", "III-D 2", 0)
    monotonic_window: int = knob(5, "pixels", "side of the window in which gradients vote", "III-D 2", 1, 31)
    monotonic_share: float = knob(0.6, "", "share of backward votes that marks a reversal", "III-D 2", 0, 1)
    jump_factor: float = knob(4.0, "", "T1: largest phase step between neighbours, in steps of a surface that faces both devices", "III-D 3", 0)
    jump_floor_rad: float = knob(0.2, "rad", "T1 is at least this", "III-D 3", 0)
    jump_sigma: float = knob(4.0, "sigma", "noise allowance added to T1", "III-D 3", 0)
    jump_links: int = knob(5, "pixels", "a pixel that continues fewer of its eight neighbours stands on a jump", "III-D 3", 0, 8)
    island_share: float = knob(0.0005, "", "T2: smallest domain, as a share of the image's pixels", "III-D 3", 0, 1)
    local_window: int = knob(5, "pixels", "side of the window of the local surface", "", 3, 15)
    local_least: int = knob(6, "pixels", "fewest neighbours that make a surface", "", 4)
    local_sigma: float = knob(4.5, "sigma", "largest distance of a point from the local surface", "", 0)
    local_roughness: float = knob(2.5, "sigma", "largest rms of the neighbours about the local surface", "", 0)
    local_rounds: int = knob(1, "", "how often the local test is repeated on what is left", "", 0, 5)
    agree_sigma: float = knob(6.0, "sigma", "a view contradicts a point if it sees this far behind it", "", 0)
    agree_slack: float = knob(0.5, "pixels", "allowance for the sampling of the other view, in its pixels' footprints", "", 0)
    rim: float = knob(3.0, "projector-plane units along v", "so much of the edge of the projector's field gives no point: its blur mixes fringes with the dark outside", "", 0)
    volume_margin: float = knob(1.25, "", "the rig's measuring volume is grown by this", "", 1)


@dataclass(frozen=True)
class FuseSettings(_Section):
    """Three grids to one coloured cloud (III-C end, Fig. 12)."""

    normal_radius: int = knob(2, "pixels", "half side of the window whose points give a normal", "", 1, 15)
    max_slope: float = knob(3.0, "", "neighbours whose range differs by more than this share of their sideways distance lie across a jump", "", 0)
    jump_sigma: float = knob(5.0, "sigma", "noise that is no jump", "", 0)
    agree_sigma: float = knob(5.0, "sigma", "views whose surfaces differ by more than this, plus agree_mm, do not see the same place", "III-C", 0)
    agree_mm: float = knob(0.05, "mm", "what the calibration may make views differ by", "III-C", 0)
    oblique_deg: float = knob(60.0, "deg", "a view loses weight where it sees the surface at more than this from its normal", "III-C", 0, 89)
    grazing_deg: float = knob(80.0, "deg", "and has none left at this angle, where one pixel is too wide on the surface", "III-C", 1, 90)
    blend_mm: float = knob(3.0, "mm", "width over which a view's weight rises from its border", "Fig. 12", 0)
    hole_mm: float = knob(0.6, "mm", "holes narrower than this are no border", "Fig. 12", 0)
    separation_mm: float = knob(0.05, "mm", "least sideways distance of points of different views, or half the sampling where that is more", "Fig. 12", 0)
    gloss: float = knob(0.25, "", "a view brighter than the others by this share of their light sees a highlight and gets half its weight", "Fig. 12", 0.01)
    highlight_pixels: int = knob(4, "pixels", "width over which the weight of a picture rises from its saturated pixels", "Fig. 12", 1, 100)
    harmonise: bool = knob(True, "", "balance the pictures of different views by what they see in common", "Fig. 12")
    white_red: float = knob(1.0, "", "factor on red under the ring light (green = 1), from a picture of something white", "Fig. 12", 0.05, 20)
    white_blue: float = knob(1.0, "", "factor on blue under the ring light (green = 1)", "Fig. 12", 0.05, 20)


@dataclass(frozen=True)
class MeshSettings(_Section):
    """The cloud to a textured mesh with levels of detail."""

    triangles: int = knob(200_000, "", "triangles of surface.glb at most", "", 100)
    preview_triangles: int = knob(50_000, "", "triangles of the small level that shows first", "", 100)
    preview_pixels: int = knob(200_000, "pixels", "about so many of each view make the coarse surface that shows before the fine one", "", 1000)
    max_points: int = knob(400_000, "", "points that are triangulated at most; denser clouds are strided", "", 1000)
    max_edge: float = knob(3.5, "spacings", "longer edges bridge a hole or a shadow and go", "", 1.5)
    jump_slope: float = knob(0.35, "", "an edge that leaves both its ends' tangent planes by more than this share of its length, plus jump_sigma, is a jump", "", 0)
    jump_sigma: float = knob(5.0, "sigma", "noise that is no jump", "", 0)
    min_area_mm2: float = knob(0.5, "mm^2", "smaller pieces of surface are crumbs and go", "", 0)


@dataclass(frozen=True)
class PatternSettings(_Section):
    """Fringe direction and periods (III-C, Table I, V-B)."""

    finest_period: float = knob(36.0, "projector-plane units along v", "period of the finest set", "IV-A", 4)
    finest_steps: int = knob(8, "frames", "steps of the finest set", "Table I", 3, 64)
    coarse_steps: int = knob(4, "frames", "steps of every other set", "Table I", 3, 64)
    wrap_margin: float = knob(1.05, "", "coarsest period over what the projector's plane spans along the fringe gradient; below 1 it wraps", "V-B", 1)
    max_sets: int = knob(6, "sets", "sets that the planner may use for one direction", "", 1, 16)
    max_order_error: float = knob(1e-6, "", "probability of a wrong order that the planner accepts at the design signal", "", 0, 1)
    design_background: float = knob(20.0, "8-bit codes", "background of the darkest tissue that must still be measured", "", 0)
    design_modulation: float = knob(8.0, "8-bit codes", "modulation of the darkest tissue that must still be measured", "", 0.1)
    design_noise_a: float = knob(0.5, "8-bit codes^2", "noise variance of a dark sample, with the rounding to codes", "", 0)
    design_noise_b: float = knob(0.02, "8-bit codes", "growth of the noise variance with intensity (shot noise)", "", 0)
    response_error: float = knob(0.05, "rad", "greatest error of a coarse phase that is not noise: response curve, light from elsewhere", "", 0, 3)
    level_low: int = knob(8, "8-bit codes", "darkest level of the drawn fringes; above 0 so that the trough stays linear", "", 0, 254)
    level_high: int = knob(247, "8-bit codes", "brightest level of the drawn fringes", "", 1, 255)


@dataclass(frozen=True)
class BoardSettings(_Section):
    """Finding the board and what the projector shows on it (III-B, Fig. 4)."""

    edge_clearance: float = knob(0.2, "squares", "samples of the projector's phase stay this far from the edges of their white square", "III-B", 0.02, 0.45)
    max_samples: int = knob(4000, "", "samples of the projector's phase per picture at most, spread over all white squares", "III-B", 50)
    corner_reach: float = knob(0.44, "squares", "half side of the window in which a corner is fitted", "III-B", 0.15, 0.48)
    corner_radius: float = knob(60.0, "pixels", "the window is no larger than this", "III-B", 5, 500)
    corner_misfit: float = knob(0.04, "", "a corner whose picture misses the fitted one by more than this share of its contrast is left out", "III-B", 0)
    corner_misfit_factor: float = knob(4.0, "", "or by more than this times what is usual in the picture, if that is more", "III-B", 1)
    corner_outlier: float = knob(8.0, "", "a corner that misses the smooth lattice by more than this times the usual is left out", "III-B", 2)
    corner_saturated: float = knob(0.3, "", "a corner with more than this share of saturated pixels around it is left out", "III-B", 0, 1)
    max_blur: float = knob(0.18, "squares", "a picture with softer edges (standard deviation) is refused", "III-B", 0.01, 0.5)
    edge_pixels: float = knob(2.5, "pixels", "samples of the projector's phase stay at least this far, plus the blur, from any edge", "III-B", 1)
    min_square_pixels: int = knob(25, "pixels", "a white square with fewer usable pixels has no centre", "III-B", 6)
    phase_outlier: float = knob(4.0, "sigma", "a phase that misses its square's smooth fit by more than this is left out", "III-B", 1)
    phase_rough: float = knob(4.0, "", "a square whose phase scatters by more than this times what is usual in the picture is left out", "III-B", 1)
    min_share: float = knob(0.35, "", "pixels whose modulation is less than this share of their square's median are left out", "III-B", 0, 1)


@dataclass(frozen=True)
class CalibrateSettings(_Section):
    """Board pictures to a rig: one joint adjustment (III-B)."""

    min_poses: int = knob(3, "poses", "fewest poses that are solved at all; eight to ten are good", "III-B", 3)
    min_tilt_deg: float = knob(3.0, "deg", "boards that differ by less than this are all parallel", "III-B", 0, 90)
    square_pixels: bool = knob(False, "", "cameras have square pixels: fx = fy", "III-B")
    lens: str = knob("auto", "", "distortion of the cameras: none, k1, k1 k2, k1 k2 p1 p2, k1 k2 p1 p2 k3; auto = chosen by leaving poses out", "III-B")
    projector_lens: str = knob("auto", "", "distortion of the projector, likewise", "III-B")
    lens_gain: float = knob(5.0, "", "what a lens term may cost the poses left out, in chi-squared, and must bring them beyond the usual terms", "", 0)
    lens_confidence: float = knob(0.9, "", "one-sided confidence at which one lens model beats another on the poses left out", "", 0.5, 0.9999)
    projector: str = knob("samples", "", "what ties the projector: samples (phase at fixed camera pixels), centres (of white squares) or corners (phase read there)", "III-B, Fig. 4")
    board_shape: str = knob("flat", "", "what the board may be but flat and true: flat, bend, print (spacing of rows over that of columns, shear), bend print", "")
    bend_prior_mm: float = knob(0.3, "mm", "standard deviation of a board's sag at its corners, where it may bend", "", 1e-6)
    print_prior: float = knob(0.003, "", "standard deviation of a print's scale ratio and shear, where they may differ from none", "", 1e-9)
    focal: str = knob("", "plane units", "known focal lengths, such as camera1=12800+-50; projector=9120+-20", "")
    principal_point: str = knob("", "plane units", "known principal points, such as camera1=2735,1823+-10", "")
    camera_centre_prior: float = knob(0.1, "widths", "standard deviation of a camera's principal point about the middle of its picture: weak, for narrow fields that hardly tell", "", 1e-6)
    projector_centre_prior: float = knob(2.0, "widths", "the same for the projector, whose lens is often shifted", "", 1e-6)
    reject_sigma: float = knob(5.0, "sigma", "corners and samples that miss the solution by more than this are left out", "", 2)
    reject_sighting: float = knob(5.0, "", "a picture whose corners or phases fit this many times worse than the others' is left out", "", 1.5)
    max_phase_miss: float = knob(0.005, "projector widths", "phases that miss by more than this belong to no projector", "", 0)
    max_corner_miss: float = knob(0.1, "squares", "corners that miss by more than this belong to another board", "", 0)
    rounds: int = knob(60, "", "steps of the adjustment at most", "", 1)


@dataclass(frozen=True)
class EvidenceSettings(_Section):
    """When a calibration is called good, usable or not to be used (III-B, V-A)."""

    good_poses: int = knob(8, "poses", "fewer poses than this are called few", "III-B", 3)
    min_coverage: float = knob(0.6, "", "share of the cells of a picture that boards should reach", "III-B", 0, 1)
    min_tilt_deg: float = knob(8.0, "deg", "a side counts as tilted to if a board faces it by this much", "III-B", 0, 80)
    min_depth: float = knob(0.2, "", "depth that boards should span, as a share of the width that they fill", "III-B", 0)
    max_corner_px: float = knob(0.5, "pixels", "corners that miss by more than this are weak, four times as much is no calibration", "III-B", 0)
    max_p: float = knob(0.01, "", "a pattern in the residuals counts as real below this probability", "III-B", 0, 1)
    max_field: float = knob(0.5, "", "a real smooth field is weak above this share of the residuals' rms", "III-B", 0)
    max_predicted_px: float = knob(0.1, "pixels", "predicted error of points, in footprints of a camera's pixel: more is weak, ten times as much is no calibration", "V-A", 0)
    max_held_out: float = knob(2.0, "", "poses left out of the solve may fit this many times worse than those in it", "V-A", 1)
    max_held_out_px: float = knob(1.0, "pixels", "corners of poses left out, triangulated, in footprints of a pixel: more is weak, three times as much is no calibration", "V-A", 0)
    max_scale_ppm: float = knob(1500.0, "ppm", "the size of boards left out may be off by this", "V-A", 0)
    max_anisotropy: float = knob(0.1, "", "focal lengths of a projector of diamond layout, whose units are square, that differ by more than this share speak of another layout", "", 0)
    tight_correlation: float = knob(0.95, "", "parameters correlated more than this are listed", "", 0, 1)
    permutations: int = knob(4000, "", "turned signs that a probability is made of, where there are too many to try all", "", 100, 1_000_000)


@dataclass(frozen=True)
class ResponseSettings(_Section):
    """The response of projector and camera together: gamma, saturation (II-C)."""

    harmonics: int = knob(5, "", "harmonics of the fringe, from the second on, that may differ from the power law", "II-C", 1, 8)
    law_tolerance: float = knob(0.02, "fringe amplitudes", "how far harmonics are expected to lie from the power law; what the capture does not show stays near it", "", 1e-4, 1)
    expected_blur: float = knob(1.5, "projector-plane units", "blur of the projector that is expected (standard deviation); weakens the harmonics of fine fringes", "", 0.01, 50)
    negligible_rad: float = knob(0.005, "rad", "a phase error that need not be corrected in the sets that measure", "", 0)
    harmful_rad: float = knob(0.1, "rad", "a phase error that endangers orders, and is corrected, in the sets that only settle them", "", 0)
    significance: float = knob(4.0, "sigma", "evidence that a correction needs", "", 0)
    min_explained: float = knob(0.1, "", "share of the disagreement, in parts of the picture that it was not fitted to, that a correction must take away", "", 0, 1)
    max_sigma_rad: float = knob(0.15, "rad", "pixels whose phase is noisier than this tell nothing of the response", "", 0.001)
    min_contrast: float = knob(0.1, "", "least modulation, as a share of the background, of pixels that tell of the response", "", 0, 1)
    min_pixels: int = knob(400, "pixels", "fewest pixels that tell of the response", "", 50)
    max_pixels: int = knob(20_000, "pixels", "pixels that are looked at; more do not make it better", "", 1000)
    max_saturated: float = knob(0.02, "", "share of the lit pixels that may saturate before it is said so", "", 0, 1)


@dataclass(frozen=True)
class VerifySettings(_Section):
    """Is a rig still true? (III-E)"""

    limit: float = knob(4e-5, "working distances", "views, corners or a sphere that differ systematically by more than this say that the rig has drifted: 20 um at 500 mm", "III-E", 1e-7, 0.1)
    warn: float = knob(1e-5, "working distances", "views that differ systematically by less than this are as noise and surfaces leave them: 5 um at 500 mm; by more, and by more than the calibration promised, they are worth a warning", "III-E", 1e-7, 0.1)
    warn_promised: float = knob(5.0, "", "the same, in errors between the views that the calibration predicted", "III-E", 1)
    limit_scale_ppm: float = knob(500.0, "ppm", "a board measured too large or too small by more than this, and three standard errors, says the same", "III-E", 0)


@dataclass(frozen=True)
class WatchSettings(_Section):
    """Is the specimen still where it was scanned? (V-D)"""

    suspect_mm: float = knob(0.10, "mm", "a shift across a camera's line of sight beyond this, that noise does not explain, is SUSPECT", "IV-D", 0.001)
    stale_mm: float = knob(0.20, "mm", "and beyond this STALE", "IV-D", 0.001)
    suspect_depth_mm: float = knob(0.05, "mm", "a change of depth beyond this, re-measured with fringes, is SUSPECT", "IV-D", 0.001)
    stale_depth_mm: float = knob(0.10, "mm", "and beyond this STALE", "IV-D", 0.001)
    false_alarm: float = knob(1e-3, "", "probability that noise alone raises an alarm, over all tiles and cameras of one look", "", 1e-9, 0.1)
    pitch_mm: float = knob(0.15, "mm", "pictures are compared with pixels of about this width on the surface", "", 0.01)
    tile: int = knob(16, "such pixels", "side of the smallest tile whose shift is measured", "", 8, 128)
    levels: int = knob(3, "", "sizes of tiles, each twice the one before; the coarser ones also find larger shifts", "", 1, 6)
    tile_sigma_mm: float = knob(0.04, "mm", "a tile whose shift is less certain than this, for want of texture, has no vote", "", 0.001)
    floor_px: float = knob(0.03, "such pixels", "shifts below this are errors of the method, not of the noise", "", 0)
    floor_depth_mm: float = knob(0.005, "mm", "changes of depth below this are errors of the method, not of the noise", "", 0)
    min_surface: float = knob(0.5, "", "share of a tile that must have points of the scan", "", 0, 1)
    min_texture: float = knob(0.05, "", "share of the surface whose texture must tell shifts; else SUSPECT", "", 0, 1)
    min_judged: float = knob(0.6, "", "share of that which must be seen again; else SUSPECT", "", 0, 1)
    max_light: float = knob(0.04, "", "places whose brightness changed by more than this share, against the whole picture's, and by max_light_factor times what is usual in it, are SUSPECT: covered, cut or pressed in", "", 0.001)
    max_light_factor: float = knob(12.0, "", "see max_light: a film that dries changes a little everywhere", "", 1)
    max_light_ever: float = knob(0.5, "", "a place that changed by more than this is never as it was scanned", "", 0.001)
    max_gain: float = knob(1.6, "", "pictures brighter or darker than the scan's by more than this factor are of another light or exposure", "", 1.01)
    bright: float = knob(0.6, "", "spots brighter than a tile around them by this share are highlights and do not vote", "", 0.01)


@dataclass(frozen=True)
class CaptureSettings(_Section):
    """Playing patterns and proving that frame n is pattern n."""

    exposure_us: int = knob(16000, "us", "how long each pattern is lit", "III-A", 10, 10_000_000)
    margin_us: int = knob(200, "us", "how much longer than the pattern the cameras expose, so that they see all of it", "", 0, 1_000_000)
    timeout_s: float = knob(5.0, "s", "how long to wait for a frame", "", 0.01, 3600)
    retries: int = knob(2, "", "how often an incomplete shot is taken again", "", 0, 10)
    timing_tolerance: float = knob(0.25, "periods", "how far a frame's time may lie from its pattern's", "", 0, 0.5)
    max_wrong_frame: float = knob(0.10, "modulation", "a frame that misses its set's sinusoid by more than this, alone among the others, is not the pattern it should be", "", 0)


@dataclass(frozen=True)
class GuideSettings(_Section):
    """Strokes to the tissue and to the projector (III-F)."""

    sample_mm: float = knob(0.1, "mm", "strokes are sampled this closely on the tissue", "III-F", 0.01, 5)
    max_samples: int = knob(20_000, "", "places at which a stroke is sampled at most; longer ones are sampled more coarsely", "", 100, 1_000_000)
    window_mm: float = knob(0.15, "mm", "half side of the window of points that say where a stroke's place in a photograph lies", "III-F", 0)
    jump_mm: float = knob(0.5, "mm", "a surface that moves on by more than this from one sample to the next, and 8 times the sampling, jumps: nothing is drawn between", "", 0.01)
    max_slope: float = knob(4.0, "", "points whose range differs by more than this share of their sideways distance lie across a jump", "", 0)
    off_surface_mm: float = knob(0.5, "mm", "a place in mm that floats farther than this above the surface is not on it", "", 0.01)
    gap_mm: float = knob(0.75, "mm", "a place in mm where nothing was measured is taken as it was asked for if the surface around is no farther than this", "", 0)
    shadow_mm: float = knob(0.06, "mm", "a place that lies farther than this behind what the projector lights is in its shadow; what the surface rises within a mirror comes on top", "", 0.001)
    grazing_deg: float = knob(86.0, "deg", "light that meets the tissue at more than this from its normal only grazes it", "", 10, 90)
    normal_mm: float = knob(0.3, "mm", "half side of the window over which the surface tells its slope, for the width of lines", "", 0.01)
    brightness: float = knob(1.0, "", "greatest level of the projector's lamps that guidance may use", "", 0.01, 1)
    dash_mm: float = knob(2.0, "mm", "length of the dashes, and of the gaps, of guidance that is in doubt", "", 0.1)
    mirror_error: float = knob(0.1, "mirrors", "standard error with which a drawn line lies on the lattice of the device", "", 0)


@dataclass(frozen=True)
class LoopSettings(_Section):
    """Finding the projected lines, to measure where they landed (IV-D)."""

    station_mm: float = knob(0.5, "mm", "a projected line is looked for this closely along it", "IV-D", 0.05)
    along_mm: float = knob(0.7, "mm", "half length of the piece of line that a station looks at", "", 0.05)
    search_mm: float = knob(0.6, "mm", "how far from where it should be a line is looked for", "", 0.05, 10)
    blur_mm: float = knob(0.12, "mm", "softness of a projected line's edges that is expected (standard deviation)", "", 0.001)
    min_height: float = knob(0.2, "", "least height of a line's profile, of what it should be", "", 0, 1)
    max_misfit: float = knob(0.35, "", "greatest rms misfit of a line's profile, of its height", "", 0)
    surface_mm: float = knob(0.03, "mm", "error of the scanned surface that is expected when lines are triangulated", "", 0.001)
    max_height_mm: float = knob(0.15, "mm", "lines that lie farther off the scanned surface say that it has changed", "", 0)
    accept_um: float = knob(150.0, "um", "guidance whose lines land farther than this from the asked ones (p95) is not as it should be", "", 1)
    look_s: float = knob(0.5, "s", "pause between two looks at the specimen while guidance is shown", "", 0)
    lease_s: float = knob(0.25, "s", "the loop that shows guidance must come round within this, or it goes dark", "", 0.02, 2)
    patience_s: float = knob(10.0, "s", "guidance goes dark if nobody could look at the specimen for so long", "", 0.1)
    exposure_us: int = knob(16000, "us", "exposure of the pictures in which lines are looked for", "", 10, 10_000_000)


@dataclass(frozen=True)
class ExaminationSettings(_Section):
    """When a guideline may be projected, and for how long without a word (IV-D)."""

    verdict_s: float = knob(5.0, "s", "nothing is projected on a specimen that nobody has looked at for so long", "", 0.05, 3600)
    suspect_s: float = knob(10.0, "s", "dashed lines on a suspect specimen go out if the operator does not say in this time to go on", "", 0, 3600)
    arm_s: float = knob(60.0, "s", "what is armed and not started for so long must be armed again", "", 1, 3600)
    max_strokes: int = knob(500, "strokes", "strokes in one author's draft at most", "", 1, 100_000)


@dataclass(frozen=True)
class GuardSettings(_Section):
    """The watchdog that turns the projector dark (IV-D)."""

    beat_ms: float = knob(10.0, "ms", "from one sign of life to the next, each way", "", 1, 40)
    deadline_ms: float = knob(50.0, "ms", "without a sign for so long, the other side makes dark; what is left of 100 ms is for a busy machine", "", 5, 80)
    lease_s: float = knob(2.0, "s", "for so long at most the owner lets a thread beat for it while it is busy", "", 0.02, 60)
    start_s: float = knob(20.0, "s", "the watchdog must be ready in this time", "", 0.1, 600)


@dataclass(frozen=True)
class SpecimenSettings(_Section):
    """The specimen told from its substrate, and its size."""

    flat_mm: float = knob(0.05, "mm", "points this near to a plane lie on it, or within four sigma, if that is more", "", 0.001)
    min_substrate: float = knob(0.02, "", "share of the points that must lie on a plane for it to be the substrate", "", 0.001, 1)
    min_span: float = knob(0.15, "", "share of the field, each way, over which they must be spread", "", 0, 1)
    max_below: float = knob(0.01, "", "share of the points that may lie below the substrate", "", 0, 0.5)
    peak: float = knob(3.0, "", "points on the substrate over those in a band of the same width just above it: fewer are no plane", "", 0)
    max_tilt_deg: float = knob(40.0, "deg", "the substrate may lean so far against the projector's axis", "", 0, 80)
    low_mm: float = knob(0.06, "mm", "what is higher than this above the substrate, or than six standard deviations of it, may be specimen", "", 0.001)
    high_mm: float = knob(0.3, "mm", "a specimen is somewhere at least so high", "", 0.001)
    min_area_mm2: float = knob(8.0, "mm^2", "smaller pieces are crumbs", "", 0)
    hole_mm: float = knob(6.0, "mm", "gaps at the border of the field narrower than this are holes of it", "", 0)
    least_cell_mm: float = knob(0.15, "mm", "least side of the cells in which heights are taken", "", 0.005)
    max_points: int = knob(120_000, "", "points that are looked at; more do not make it better", "", 1000)


@dataclass(frozen=True)
class RegisterSettings(_Section):
    """One scan's surface laid on another's."""

    max_shift_mm: float = knob(6.0, "mm", "a surface that has moved farther is not followed", "", 0.1, 100)
    max_turn_deg: float = knob(6.0, "deg", "nor one that has turned by more", "", 0.1, 45)
    min_inliers: float = knob(0.55, "", "least share of the surface that must fit within inlier_mm: less is another specimen, or bent", "", 0.1, 1)
    inlier_mm: float = knob(0.08, "mm", "what fits lies this near to the other surface along the normal, or within four sigma (up to three times this)", "", 0.001)
    floor_mm: float = knob(0.003, "mm", "error of a point beside its own noise (sampling, calibration) by which pairs are weighed", "", 0)
    plain_mm: float = knob(0.03, "mm", "surfaces that meet this well without being searched for are not searched for elsewhere", "", 0)
    loose_share: float = knob(0.002, "", "a motion that the surface tells less than this, of what it tells best, is not told: 0.002 is a slope of 2.6 degrees", "", 1e-9, 0.5)
    rounds: int = knob(40, "", "steps on all points at most", "", 3)


@dataclass(frozen=True)
class CompareSettings(_Section):
    """What changed between two scans."""

    sigma: float = knob(4.0, "sigma", "a change counts where it exceeds this, of noise, registration and what unchanged places show", "", 1)
    least_mm: float = knob(0.03, "mm", "and by how much more", "", 0)
    min_area_mm2: float = knob(2.0, "mm^2", "smaller changes are crumbs", "", 0)
    margin_mm: float = knob(0.5, "mm", "the volume of a change is taken so far around it, where it falls below what counts", "", 0)
    patch_mm: float = knob(5.0, "mm", "errors of unchanged places farther apart than this are independent", "", 0.1)
    kerf_mm: float = knob(5.0, "mm", "a narrower and long removed region is a kerf: its centre line is the cut; else its rim is", "", 0)
    max_depth_mm: float = knob(40.0, "mm", "a deeper change is none: something else lies there", "", 0.1)
    min_common: float = knob(0.3, "", "share of the first surface that must be seen again", "", 0, 1)
    max_points: int = knob(1_000_000, "", "points of each surface that are looked at", "", 1000)


@dataclass(frozen=True)
class Settings(_Section):
    """The whole tree, as stored in every scan."""

    phase: PhaseSettings = field(default_factory=PhaseSettings)
    denoise: DenoiseSettings = field(default_factory=DenoiseSettings)
    fuse: FuseSettings = field(default_factory=FuseSettings)
    mesh: MeshSettings = field(default_factory=MeshSettings)
    patterns: PatternSettings = field(default_factory=PatternSettings)
    capture: CaptureSettings = field(default_factory=CaptureSettings)
    board: BoardSettings = field(default_factory=BoardSettings)
    calibrate: CalibrateSettings = field(default_factory=CalibrateSettings)
    evidence: EvidenceSettings = field(default_factory=EvidenceSettings)
    response: ResponseSettings = field(default_factory=ResponseSettings)
    verify: VerifySettings = field(default_factory=VerifySettings)
    guide: GuideSettings = field(default_factory=GuideSettings)
    loop: LoopSettings = field(default_factory=LoopSettings)
    watch: WatchSettings = field(default_factory=WatchSettings)
    examination: ExaminationSettings = field(default_factory=ExaminationSettings)
    guard: GuardSettings = field(default_factory=GuardSettings)
    specimen: SpecimenSettings = field(default_factory=SpecimenSettings)
    register: RegisterSettings = field(default_factory=RegisterSettings)
    compare: CompareSettings = field(default_factory=CompareSettings)


def to_dict(s: Settings) -> dict[str, Any]:
    """Plain dictionaries and numbers, for JSON or YAML."""
    return dataclasses.asdict(s)


def from_dict(d: Mapping[str, Any], base: Settings | None = None) -> Settings:
    """Settings from nested dictionaries; what is not named keeps the value of `base` (default: the defaults).

    Raises UsageError for an unknown section or name, a wrong type or a value out of range.
    """
    base = base or Settings()
    sections = typing.get_type_hints(Settings)
    changed: dict[str, Any] = {}
    for name, part in d.items():
        if name not in sections:
            raise UsageError(f"settings: unknown section '{name}'; there are {', '.join(sections)}")
        if not isinstance(part, Mapping):
            raise UsageError(f"settings: section '{name}' is {part!r}; needed names with values")
        known = {f.name for f in dataclasses.fields(sections[name])}
        for key in part:
            if key not in known:
                raise UsageError(f"settings: '{name}' has no '{key}'; it has {', '.join(sorted(known))}")
        changed[name] = dataclasses.replace(getattr(base, name), **part)
    return dataclasses.replace(base, **changed)


def to_yaml(s: Settings) -> str:
    """The tree as YAML, every field with its unit and meaning as a comment."""
    import yaml

    lines: list[str] = []
    current = ""
    for section, f, value in describe(s):
        if section != current:
            lines.append(f"{section}:")
            current = section
        shown = yaml.safe_dump(value, default_flow_style=True).replace("\n...", "").strip()
        unit = f" {f.metadata['unit']};" if f.metadata["unit"] else ""
        lines.append(f"  {f.name}: {shown}  #{unit} {f.metadata['doc']}")
    return "\n".join(lines) + "\n"


def from_yaml(text: str, base: Settings | None = None) -> Settings:
    """Settings from YAML text. Raises UsageError as `from_dict`, and for text that is not YAML."""
    import yaml  # who changes no setting does without it

    try:
        d = yaml.safe_load(text)
    except yaml.YAMLError as e:
        raise UsageError(f"settings: not YAML: {str(e).splitlines()[0]}") from e
    if d is None:
        d = {}
    if not isinstance(d, Mapping):
        raise UsageError("settings: needed sections with names and values")
    return from_dict(d, base)


def describe(s: Settings | None = None) -> Iterator[tuple[str, dataclasses.Field[Any], Any]]:
    """Every knob: (section name, field with its metadata, value)."""
    s = s or Settings()
    for sec in dataclasses.fields(s):
        part = getattr(s, sec.name)
        for f in dataclasses.fields(part):
            yield sec.name, f, getattr(part, f.name)
