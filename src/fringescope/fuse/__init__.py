"""Grids and ring-light pictures to one coloured cloud and a textured surface (III-C end, Fig. 12)."""

from fringescope.fuse.mesh import preview, surface
from fringescope.fuse.photo import decode_srgb, encode_srgb, photo, photo_from_background, white_gains
from fringescope.fuse.points import Fused, all_points, cloud, merge, normals

__all__ = [
    "Fused",
    "all_points",
    "cloud",
    "decode_srgb",
    "encode_srgb",
    "merge",
    "normals",
    "photo",
    "photo_from_background",
    "preview",
    "surface",
    "white_gains",
]
