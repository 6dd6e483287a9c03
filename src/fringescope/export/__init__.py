"""Other people's formats: PLY, GLB, STL, OBJ, PCD, 3MF, E57, and a page that shows a surface in any browser."""

from fringescope.export.board import best_board, describe, design, draw, paper_size, pdf_bytes, svg_text
from fringescope.export.glb import encode_picture, glb_bytes, preview_bytes, write_glb, write_preview
from fringescope.export.glb_in import read_glb, read_pictures
from fringescope.export.others import write_3mf, write_e57, write_obj, write_pcd, write_stl
from fringescope.export.packed import can_pack, coarse_bytes, packed_bytes, thinned
from fringescope.export.ply import read_ply, write_ply
from fringescope.export.viewer import viewer_page

__all__ = [
    "best_board", "can_pack", "coarse_bytes", "describe", "design", "draw", "encode_picture", "glb_bytes",
    "packed_bytes", "paper_size", "pdf_bytes", "preview_bytes", "read_glb", "read_pictures", "read_ply",
    "svg_text", "thinned", "viewer_page", "write_3mf", "write_e57", "write_glb", "write_obj", "write_pcd",
    "write_ply", "write_preview", "write_stl",
]  # fmt: skip
