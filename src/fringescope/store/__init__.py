"""Our folders and files: captures, rigs, scans; versioned, checksummed, written whole or not at all."""

from fringescope.store.capture import (
    Capture,
    CaptureView,
    Frames,
    check_rig,
    hash_capture,
    put_capture,
    put_patterns,
    read_capture,
    view_inputs,
    write_capture,
)
from fringescope.store.comparison import check_pair, put_comparison, read_strokes
from fringescope.store.files import new_file, new_folder, write_json
from fringescope.store.guidelines import (
    check_replaced,
    check_stroke,
    guidelines_document,
    is_guidelines,
    parse_guidelines,
    pattern_document,
    read_guidelines,
)
from fringescope.store.images import Images, write_png, write_tiff
from fringescope.store.response import read_response, response_document
from fringescope.store.rig import hash_rig, read_rig, rig_document, write_rig
from fringescope.store.scan import (
    StoredScan,
    lost,
    plain,
    put_decoded,
    put_scan,
    read_scan,
    write_decoded,
    write_scan,
)
from fringescope.store.session import (
    Session,
    board_document,
    calibration_document,
    parse_board,
    read_board,
    read_observations,
    read_session,
)
from fringescope.store.spool import spooled

__all__ = [
    "Capture",
    "CaptureView",
    "Frames",
    "Images",
    "Session",
    "StoredScan",
    "board_document",
    "calibration_document",
    "check_pair",
    "check_replaced",
    "check_rig",
    "check_stroke",
    "guidelines_document",
    "hash_capture",
    "hash_rig",
    "is_guidelines",
    "lost",
    "new_file",
    "new_folder",
    "parse_board",
    "parse_guidelines",
    "pattern_document",
    "plain",
    "put_capture",
    "put_comparison",
    "put_decoded",
    "put_patterns",
    "put_scan",
    "read_board",
    "read_capture",
    "read_guidelines",
    "read_observations",
    "read_response",
    "read_rig",
    "read_scan",
    "read_session",
    "read_strokes",
    "response_document",
    "rig_document",
    "spooled",
    "view_inputs",
    "write_capture",
    "write_decoded",
    "write_json",
    "write_png",
    "write_rig",
    "write_scan",
    "write_tiff",
]
