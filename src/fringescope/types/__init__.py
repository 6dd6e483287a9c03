"""What travels between the stages: frozen values without behaviour beyond checking themselves once.

Letters of the axes, everywhere: N frames, H rows, W columns, V views, D fringe directions. Units: millimetres, seconds,
radians; projector-plane units for fringe periods. `T_ab` maps b to a. See `docs/conventions.md`.
"""

from fringescope.types.calibration import I32, Board, Calibration, LeftOut, Parameter, Residuals, Sighting
from fringescope.types.capture import (
    FrameKey,
    FringeSet,
    GraySet,
    NoiseModel,
    PatternPlan,
    Role,
    ViewInput,
    ViewPlan,
)
from fringescope.types.names import F32, F64, U8, U16, U32, AnyArray, Bool, Layout, PixelFormat, Reason
from fringescope.types.results import (
    Cloud,
    Decoded,
    Direction,
    GrayCode,
    Grid,
    Photo,
    Scan,
    Surface,
    SurfacePart,
    ViewVerdict,
    WrappedSet,
)
from fringescope.types.rig import Camera, Lens, Pose, Projector, Rig, Volume, plane_size

__all__ = [
    "F32",
    "F64",
    "I32",
    "U8",
    "U16",
    "U32",
    "AnyArray",
    "Board",
    "Bool",
    "Calibration",
    "Camera",
    "Cloud",
    "Decoded",
    "Direction",
    "FrameKey",
    "FringeSet",
    "GrayCode",
    "GraySet",
    "Grid",
    "Layout",
    "LeftOut",
    "Lens",
    "NoiseModel",
    "Parameter",
    "PatternPlan",
    "Photo",
    "PixelFormat",
    "Pose",
    "Projector",
    "Reason",
    "Residuals",
    "Rig",
    "Role",
    "Scan",
    "Sighting",
    "Surface",
    "SurfacePart",
    "ViewInput",
    "ViewPlan",
    "ViewVerdict",
    "Volume",
    "WrappedSet",
    "plane_size",
]
