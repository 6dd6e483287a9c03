"""Other people's formats: PLY, GLB, STL, OBJ, PCD, 3MF, and a page that shows a surface without anything installed."""

from fringescope.export.glb import encode_picture, glb_bytes, write_glb
from fringescope.export.ply import read_ply, write_ply
from fringescope.export.viewer import viewer_page

__all__ = ["encode_picture", "glb_bytes", "read_ply", "viewer_page", "write_glb", "write_ply"]
