"""Frames drawn from formulas, and rigs whose truth comes from OpenCV: what the tests of the measuring core share."""

import cv2
import numpy as np

from fringescope.types import FringeSet, PixelFormat, Role, ViewInput, ViewPlan
from tests.reference import rays
from tests.reference.fringes import gray_words

TWO_PI = 2 * np.pi


def draw(plan, u, v, A=110.0, B=70.0, noise=(0.0, 0.0), rng=None, gray_shift=0.0, lit=True):
    """Every frame of a plan for the projector coordinates u, v (H, W) that the pixels see, in the order of the plan.

    A and B are in codes; a set's exposure (us, 1000 = 1) scales both; `gray_shift` moves the Gray code, in units.
    """
    frames = []
    for key in plan.keys:
        one = plan.sets[key.set_index]
        exposure = 1.0
        if isinstance(one, FringeSet):
            gx, gy = one.cycles_per_pixel
            light = A + B * np.cos(TWO_PI * (gx * u + gy * v) - TWO_PI * key.number / one.steps)
            exposure = (one.exposure_us or 1000.0) / 1000.0
        elif key.role in (Role.WHITE, Role.BLACK):
            light = A + (B if key.role is Role.WHITE else -B) + 0 * u
        else:
            words = np.array(gray_words(one.bits))
            at = (u if one.axis == "u" else v) + gray_shift
            value = np.clip(np.floor((at + 0.5) / one.cell).astype(int), 0, len(words) - 1)
            bit = words[value, key.number]
            light = A + B * np.where(bit == (0 if key.role is Role.INVERSE else 1), 1, -1)
        light = exposure * np.where(lit, light, 0.0)
        if rng is not None:
            light = light + rng.normal(size=light.shape) * np.sqrt(noise[0] + noise[1] * np.maximum(light, 0))
        top = plan.pixel_format.max_value
        frames.append((key, np.clip(np.rint(light), 0, top).astype(plan.pixel_format.dtype)))
    return frames


def plan(*sets, pixel_format=PixelFormat.MONO12, plane=(400, 300), camera="camera1"):
    """A view's plan."""
    return ViewPlan(camera, pixel_format, tuple(sets), plane)


def fringes(period, angle=0.0, steps=4, exposure_us=None):
    """A fringe set of a period (plane units) whose gradient points along `angle` (radians from u to v)."""
    return FringeSet((float(np.cos(angle) / period), float(np.sin(angle) / period)), steps, exposure_us)


def image(plane=(400, 300), shape=(40, 60)):
    """Projector coordinates (u, v) of a smooth, slightly bent surface that fills the plane."""
    y, x = np.meshgrid(np.linspace(0, 1, shape[0]), np.linspace(0, 1, shape[1]), indexing="ij")
    u = 2 + (plane[0] - 5) * (x + 0.03 * np.sin(3 * y) * x * (1 - x))
    return u, 2 + (plane[1] - 5) * (y + 0.03 * np.cos(2 * x) * y * (1 - y))


def plane_points(camera, normal, offset):
    """Where the rays of a camera's pixels meet the plane normal . p = offset: (H, W, 3), by OpenCV's lens."""
    n = np.asarray(normal, float) / np.linalg.norm(normal)
    o, d = rays.camera_rays(camera)
    return o + d * ((offset - n @ o) / (d @ n))[..., None]


def seen(rig, p):
    """Projector coordinates (u, v) and whether the projector lights them, of points (H, W, 3)."""
    uv = rays.projector_uv(rig.projector, p).reshape(*p.shape[:-1], 2)
    W, H = rig.projector.plane_size
    lit = (uv[..., 0] > -0.5) & (uv[..., 0] < W - 0.5) & (uv[..., 1] > -0.5) & (uv[..., 1] < H - 0.5)
    return uv[..., 0], uv[..., 1], lit


def best_angle(rig, camera, at=(0.0, 0.0, 0.0)):
    """Direction on the projector plane in which a point moves along the camera's ray towards the camera."""
    p = np.asarray(at, float)
    towards = -camera.pose.R.T @ camera.pose.t - p
    towards /= np.linalg.norm(towards)
    (u0, v0), (u1, v1) = rays.projector_uv(rig.projector, np.stack([p, p + 0.5 * towards]))
    return float(np.arctan2(v1 - v0, u1 - u0))


def view(rig, camera, points, periods=(270.0, 60.0, 16.0), steps=(4, 4, 8), noise=(0.5, 0.02), rng=None, **kw):
    """A camera's frames of a surface (H, W, 3), fringes along its own best direction: (ViewInput, angle)."""
    angle = best_angle(rig, camera)
    sets = [fringes(p, angle, n) for p, n in zip(periods, steps, strict=True)]
    made = plan(*sets, pixel_format=PixelFormat.MONO8, plane=rig.projector.plane_size, camera=camera.name)
    u, v, lit = seen(rig, points)
    return ViewInput(made, draw(made, u, v, noise=noise, rng=rng, lit=lit, **kw)), angle


def random_pose(eye, target, roll):
    """OpenCV-style (R, t) of a device at `eye` that looks at `target`, rolled about its axis."""
    z = np.asarray(target, float) - eye
    z /= np.linalg.norm(z)
    x = np.cross([0.3, 1.0, 0.1], z)
    x /= np.linalg.norm(x)
    R = cv2.Rodrigues(np.array([0, 0, roll]))[0] @ np.stack([x, np.cross(z, x), z])
    return R, -R @ np.asarray(eye, float)
