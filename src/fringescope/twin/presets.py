"""Instruments of the twin: the paper's rig at any scale of its sensors, and rigs with one, two and five cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from fringescope.errors import UsageError
from fringescope.twin.optics import CameraOptics, ProjectorOptics, Sensor
from fringescope.types import Camera, Layout, Lens, PixelFormat, Pose, Projector, Rig, Volume

WORKING_HEIGHT = 500.0  #: mm from the projector to the working plane z = 0
BASELINE = 320.0  #: mm from the projector to each camera
SENSOR = (5472, 3648)  #: pixels of the full sensor, 2.4 um wide
CAMERA_F = 29470.0  #: focal length in full-size pixels: 10 x 6 cm fill the sensor
DMD_UNIT = 0.0054  #: mm, unit of the projector plane


@dataclass(frozen=True)
class RingLight:
    """White lamps on a circle above the specimen: radius and height in mm."""

    radius: float = 90.0
    height: float = 460.0
    lamps: int = 8
    colour: tuple[float, float, float] = (0.95, 1.0, 0.90)
    brightness: float = 0.75
    softness: float = 0.18  #: least roughness with which its lamps are mirrored: a diffuser spreads them


@dataclass(frozen=True, eq=False)
class Instrument:
    """A simulated instrument: its exact rig and how its parts behave.

    `electrons`: photo-electrons that a white surface at the working point, fully lit, makes in a green pixel in
    one standard exposure. `projector_colour`, `ambient`: red, green, blue of its light and of the room's
    (share of full projector light).
    """

    rig: Rig
    pixel_formats: tuple[PixelFormat, ...]
    projector: ProjectorOptics = field(default_factory=ProjectorOptics)
    camera: CameraOptics = field(default_factory=CameraOptics)
    sensor: Sensor = field(default_factory=Sensor)
    ring: RingLight = field(default_factory=RingLight)
    electrons: float = 15500.0
    standard_exposure_us: int = 16000
    projector_colour: tuple[float, float, float] = (0.94, 1.0, 0.92)
    ambient: tuple[float, float, float] = (0.012, 0.012, 0.012)
    readout_us: int = 55000  #: of a full-height frame at scale 1; fewer rows read faster

    def ideal(self) -> Instrument:
        """The same without blur, falloff, room light or projector leakage: for tests against analytic truth."""
        from dataclasses import replace

        return replace(
            self,
            projector=replace(self.projector, blur_units=0.9, aperture_mm=0.0, falloff=0.0, contrast=1e9),
            camera=replace(self.camera, aperture_mm=0.0, falloff=0.0),
            ambient=(0.0, 0.0, 0.0),
        )


def names() -> tuple[str, ...]:
    """The presets that `instrument` knows."""
    return ("paper", "single", "pair", "five")


def look_at(position: tuple[float, float, float], target: tuple[float, float, float], roll: float = 0.0) -> Pose:
    """Pose of a device at `position` whose axis meets `target`; image columns along world x as far as possible."""
    c, p = np.asarray(position, dtype=np.float64), np.asarray(target, dtype=np.float64)
    z = (p - c) / np.linalg.norm(p - c)
    x = np.array([-z[2], 0.0, z[0]])
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    x, y = math.cos(roll) * x + math.sin(roll) * y, math.cos(roll) * y - math.sin(roll) * x
    R = np.stack([x, y, z])
    return Pose(R, -R @ c)


def scaled(lens: Lens, scale: float) -> Lens:
    """The same lens before a sensor of `scale` times as many, larger pixels each way; pixel (0, 0) keeps its outer
    corner.
    """
    w, h = round(lens.width * scale), round(lens.height * scale)
    if w < 8 or h < 8:
        raise UsageError(f"scale {scale} leaves {w} x {h} pixels; needed at least 8 x 8")
    sx, sy = w / lens.width, h / lens.height
    K = np.array(lens.K)
    K[0] *= sx
    K[1] *= sy
    K[0, 2] += 0.5 * sx - 0.5
    K[1, 2] += 0.5 * sy - 0.5
    return Lens(w, h, K, lens.distortion)


def dlp4500(layout: Layout = Layout.DIAMOND) -> Projector:
    """A DLP4500 at WORKING_HEIGHT, looking down: 10 x 6 cm at the working plane, with a real lens' distortion."""
    f = 9120.0
    pose = look_at((0.9, -1.9, WORKING_HEIGHT), (0.4, -0.3, 0.0), roll=0.002)
    d = np.array([-0.051, 0.115, 2.6e-5, 4.5e-4, 0.0])
    if layout is Layout.DIAMOND:
        K = np.array([[f, 0, 908.0], [0, f + 2.0, 561.0], [0, 0, 1]])
        return Projector(912, 1140, layout, Lens(1824, 1140, K, d), pose)
    K = np.array([[f / 2, 0, 453.6], [0, f + 2.0, 561.0], [0, 0, 1]])
    return Projector(912, 1140, layout, Lens(912, 1140, K, d), pose)


def camera_around(name: str, azimuth_deg: float, number: int, scale: float, pitch: float = 1.0) -> Camera:
    """A camera BASELINE from the projector's axis at an azimuth, aimed at the working point with a mount's small
    errors.

    `pitch`: pixel size in units of 2.4 um.
    """
    rng = np.random.default_rng([4500, number])
    a = math.radians(azimuth_deg)
    at = (BASELINE * math.cos(a), BASELINE * math.sin(a), WORKING_HEIGHT - 3.0)
    dx, dy, dz = rng.uniform(-2.5, 2.5, 3)
    aim = rng.uniform(-1.5, 1.5, 2)
    pose = look_at((at[0] + dx, at[1] + dy, at[2] + dz), (aim[0], aim[1], 0.0), roll=rng.uniform(-0.006, 0.006))
    f = CAMERA_F * (1 + rng.uniform(-0.004, 0.004)) / pitch
    w, h = round(SENSOR[0] / pitch), round(SENSOR[1] / pitch)
    u0, v0 = (w - 1) / 2 + rng.uniform(-25, 25) / pitch, (h - 1) / 2 + rng.uniform(-25, 25) / pitch
    K = np.array([[f, 0, u0], [0, f * (1 + 1e-4), v0], [0, 0, 1]])
    d = np.array([-0.27 + rng.uniform(-0.03, 0.03), 2.9 + rng.uniform(-0.5, 0.5), *rng.uniform(-3e-4, 3e-4, 2), 0.0])
    return Camera(name, scaled(Lens(w, h, K, d), scale), pose)


def instrument(preset: str = "paper", scale: float = 1.0, layout: Layout = Layout.DIAMOND) -> Instrument:
    """An instrument by name; `scale` scales its sensors' pixels (0.125: 684 x 456 of 5472 x 3648).

    paper: three BayerRG8 cameras at 120 degrees. single: one Mono12. pair: two BayerRG8, left and right. five:
    five BayerRG8 at 72 degrees. Raises UsageError for an unknown name or a scale outside 0.01..1.
    """
    if not (math.isfinite(scale) and 0.01 <= scale <= 1.0):
        raise UsageError(f"scale {scale}; needed 0.01 to 1")
    around = {
        "paper": (90.0, 210.0, 330.0),
        "single": (90.0,),
        "pair": (180.0, 0.0),
        "five": (90.0, 162.0, 234.0, 306.0, 18.0),
    }
    if preset not in around:
        raise UsageError(f"preset '{preset}' is unknown; there are {', '.join(names())}")
    cameras = tuple(camera_around(f"camera{i + 1}", a, i, scale) for i, a in enumerate(around[preset]))
    volume = Volume(np.zeros(3), np.eye(3), np.array([52.0, 33.0, 24.0]))
    kind = PixelFormat.MONO12 if preset == "single" else PixelFormat.BAYER_RG8
    return Instrument(
        Rig(dlp4500(layout), cameras, volume), (kind,) * len(cameras), readout_us=max(1, round(55000 * scale))
    )
