"""Our folders and files: captures, rigs, scans; versioned, checksummed, written whole or not at all."""

from fringescope.store.capture import (
    Capture,
    CaptureView,
    Frames,
    hash_capture,
    put_capture,
    read_capture,
    view_inputs,
    write_capture,
)
from fringescope.store.files import new_file, new_folder
from fringescope.store.rig import hash_rig, read_rig, rig_document, write_rig

__all__ = [
    "Capture",
    "CaptureView",
    "Frames",
    "hash_capture",
    "hash_rig",
    "new_file",
    "new_folder",
    "put_capture",
    "read_capture",
    "read_rig",
    "rig_document",
    "view_inputs",
    "write_capture",
    "write_rig",
]
