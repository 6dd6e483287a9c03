"""A calibrated instrument: lenses, poses, devices, the measuring volume."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from fringescope.errors import RigError
from fringescope.types.names import F64, Layout


def _vector(a: Any, shape: tuple[int, ...], what: str) -> F64:
    try:
        v = np.array(a, dtype=np.float64)
    except (TypeError, ValueError) as e:
        raise RigError(f"{what}: not numbers; needed an array of shape {shape}") from e
    if v.shape != shape:
        raise RigError(f"{what}: shape {v.shape}; needed {shape}")
    if not np.isfinite(v).all():
        raise RigError(f"{what}: contains NaN or infinity; needed finite numbers")
    v.setflags(write=False)
    return v


@dataclass(frozen=True, eq=False)
class Lens:
    """Pinhole and OpenCV's five-term distortion of one device, on its plane of `width` x `height` units.

    For a camera the plane is its pixels; for a projector it is the projector plane of `Layout`.
    `K` is (3, 3), `distortion` is (5,) = [k1, k2, p1, p2, k3]. Raises RigError if it cannot be a lens.
    """

    width: int
    height: int
    K: F64
    distortion: F64

    def __post_init__(self) -> None:
        K = _vector(self.K, (3, 3), "K")
        if not (K[0, 0] > 0 and K[1, 1] > 0) or K[1, 0] != 0 or K[2, 0] != 0 or K[2, 1] != 0 or K[2, 2] != 1:
            raise RigError(f"K: {K.tolist()}; needed [[fx, s, u0], [0, fy, v0], [0, 0, 1]] with positive fx, fy")
        if self.width < 1 or self.height < 1:
            raise RigError(f"size {self.width} x {self.height}; needed at least 1 x 1")
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "distortion", _vector(self.distortion, (5,), "distortion"))


@dataclass(frozen=True, eq=False)
class Pose:
    """Rigid transform T_device_world: `p_device = R @ p_world + t`, R (3, 3) a rotation, t (3,) in mm."""

    R: F64
    t: F64

    def __post_init__(self) -> None:
        R = _vector(self.R, (3, 3), "R")
        if not np.allclose(R @ R.T, np.eye(3), atol=1e-4) or np.linalg.det(R) < 0:
            raise RigError("R: not a rotation; needed R R^T = 1 with determinant +1")
        U, _, Vt = np.linalg.svd(R)
        R = U @ Vt
        R.setflags(write=False)
        object.__setattr__(self, "R", R)
        object.__setattr__(self, "t", _vector(self.t, (3,), "t"))


@dataclass(frozen=True, eq=False)
class Camera:
    """One camera of a rig: its name, lens and pose."""

    name: str
    lens: Lens
    pose: Pose


@dataclass(frozen=True, eq=False)
class Projector:
    """The projector, an inverse camera. `width` x `height` device pixels on a `layout`; the lens acts on its plane."""

    width: int
    height: int
    layout: Layout
    lens: Lens
    pose: Pose

    @property
    def plane_size(self) -> tuple[int, int]:
        """Extent of the projector plane in its units (u, v)."""
        return plane_size(self.width, self.height, self.layout)


def plane_size(width: int, height: int, layout: Layout) -> tuple[int, int]:
    """Extent (u, v) of the projector plane of a device of `width` x `height` pixels."""
    return (2 * width if layout is Layout.DIAMOND else width, height)


@dataclass(frozen=True, eq=False)
class Volume:
    """An oriented box in world mm, where the specimen may be: `axes` rows are unit vectors, `half_size` along each."""

    center: F64
    axes: F64
    half_size: F64

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", _vector(self.center, (3,), "volume.center"))
        axes = _vector(self.axes, (3, 3), "volume.axes")
        if not np.allclose(axes @ axes.T, np.eye(3), atol=1e-3):
            raise RigError("volume.axes: rows are not perpendicular unit vectors")
        object.__setattr__(self, "axes", axes)
        h = _vector(self.half_size, (3,), "volume.half_size")
        if not (h > 0).all():
            raise RigError(f"volume.half_size: {h.tolist()}; needed three positive lengths in mm")
        object.__setattr__(self, "half_size", h)


@dataclass(frozen=True, eq=False)
class Rig:
    """A calibrated instrument: one projector and one or more cameras in one world frame, mm.

    `extra` keeps keys of the file that we do not use, so that nothing is lost when it is written again.
    """

    projector: Projector
    cameras: tuple[Camera, ...]
    volume: Volume | None = None
    extra: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))

    def __post_init__(self) -> None:
        names = [c.name for c in self.cameras]
        if not names:
            raise RigError("the rig has no cameras; needed at least one")
        if len(set(names)) != len(names):
            raise RigError(f"camera names {names}: not unique")

    @property
    def devices(self) -> tuple[Camera | Projector, ...]:
        """The projector, then the cameras."""
        return (self.projector, *self.cameras)

    def index(self, name: str) -> int:
        """0-based index of the camera `name`. Raises RigError if the rig lacks it."""
        for i, c in enumerate(self.cameras):
            if c.name == name:
                return i
        raise RigError(f"the rig lacks camera '{name}'; it has {', '.join(c.name for c in self.cameras)}")

    def camera(self, name: str) -> Camera:
        """The camera `name`. Raises RigError if the rig lacks it."""
        return self.cameras[self.index(name)]
