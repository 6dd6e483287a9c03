"""Calibration sessions: board.json and one capture per pose; the observations of a solved rig, kept in its file."""

from __future__ import annotations

import base64
import binascii
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from fringescope.errors import CalibrationError, FormatError
from fringescope.store import files
from fringescope.store.capture import Capture, read_usable
from fringescope.store.rig import explain
from fringescope.types import AnyArray, Board, Calibration, Sighting

MOST_BYTES = 1 << 30  #: no stored array is larger


class _Board(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow", frozen=True)

    pattern: str
    inner_corners: list[int] | None = Field(default=None, min_length=2, max_length=2)
    squares: list[int] | None = Field(default=None, min_length=2, max_length=2)
    square_mm: float
    marker_mm: float = 0.0
    dictionary: str = ""


@dataclass(frozen=True)
class Session:
    """Board captures, one per pose, in the order of their names. `sizes` maps camera names to (width, height).

    `left_out` says why a pose ("pose03") or one camera's picture of it ("pose03/camera1") is not among them.
    """

    folder: Path
    board: Board
    poses: tuple[tuple[str, Capture], ...]
    sizes: Mapping[str, tuple[int, int]]
    left_out: Mapping[str, str] = field(default_factory=dict)


def parse_board(doc: Mapping[str, Any], path: Path) -> Board:
    """The board that a `board.json` describes. Raises FormatError, with what is missing, or CalibrationError."""
    try:
        m = _Board.model_validate(dict(doc))
    except ValidationError as e:
        raise FormatError(explain(e, path)) from None
    try:
        if m.pattern == "checkerboard":
            if m.inner_corners is None:
                raise FormatError(f'{path}: a checkerboard lacks "inner_corners": [columns, rows]')
            columns, rows = m.inner_corners
            return Board((columns + 1, rows + 1), float(m.square_mm))
        if m.pattern == "charuco":
            if m.squares is None or not m.dictionary or not m.marker_mm:
                raise FormatError(f'{path}: a charuco board needs "squares", "square_mm", "marker_mm", "dictionary"')
            return Board((m.squares[0], m.squares[1]), float(m.square_mm), float(m.marker_mm), m.dictionary)
    except CalibrationError as e:
        raise CalibrationError(f"{path}: {e}") from None
    raise FormatError(f'{path}: pattern {files.shown(m.pattern)}; needed "checkerboard" or "charuco"')


def board_document(board: Board) -> dict[str, Any]:
    """The board as the JSON object of its `board.json`."""
    if not board.dictionary:
        return {
            "pattern": "checkerboard", "inner_corners": list(board.inner_corners), "square_mm": board.square_mm,
        }  # fmt: skip
    return {
        "pattern": "charuco", "squares": list(board.squares), "square_mm": board.square_mm,
        "marker_mm": board.marker_mm, "dictionary": board.dictionary,
    }  # fmt: skip


def read_board(path: Path | str) -> Board:
    """The board of a `board.json`. Raises FormatError or CalibrationError."""
    path = Path(path)
    return parse_board(files.read_json(path, "a board"), path)


def read_session(path: Path | str, board: Board | None = None) -> Session:
    """A folder with `board.json` and one capture per pose; `board` stands in for the file.

    Pictures that lack a frame, and folders called like the poses without a capture, are left out by name.
    Raises FormatError or CaptureError for a file that is wrong, CalibrationError for captures that do not belong
    together: another projector, a camera whose pictures change size.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise FormatError(f"{folder}: no such folder; needed {files.BOARD} and a capture per pose (pose00/, ..)")
    if board is None and not (folder / files.BOARD).exists():
        raise FormatError(f"{folder}: no {files.BOARD} in it; it tells the squares, such as "
                          '{"pattern": "checkerboard", "inner_corners": [11, 8], "square_mm": 5.0}')  # fmt: skip
    board = board or read_board(folder / files.BOARD)
    names = sorted(p.name for p in folder.iterdir() if (p / files.CAPTURE).is_file())
    if not names:
        raise FormatError(f"{folder}: no captures in it; needed a folder with {files.CAPTURE} per pose (pose00/, ..)")
    left_out = dict.fromkeys(_empty(folder, names), f"no {files.CAPTURE} in it; it describes the frames")
    read: list[tuple[str, Capture]] = []
    for n in names:
        capture, lost = read_usable(folder / n)
        read.append((n, capture))
        left_out |= {f"{n}/{camera}": why for camera, why in lost.items()}
    poses = tuple(read)
    sizes: dict[str, tuple[int, int]] = {}
    first_of: dict[str, str] = {}
    first = poses[0][1]
    for name, c in poses:
        if _projector(c) != _projector(first):
            raise CalibrationError(
                f"{folder / name}: projector {_projector(c)}, in {names[0]} it is {_projector(first)}; "
                "one session has one projector"
            )
        for v in c.views:
            size = v.size
            if sizes.setdefault(v.camera, size) != size:
                w, h = sizes[v.camera]
                raise CalibrationError(
                    f"{folder / name}: pictures of {v.camera} are {size[0]} x {size[1]}, in {first_of[v.camera]} "
                    f"{w} x {h}; capture every pose at one size"
                )
            first_of.setdefault(v.camera, name)
    return Session(folder, board, poses, sizes, left_out)


def _empty(folder: Path, poses: Sequence[str]) -> list[str]:
    """Folders without a capture whose names differ from those of poses by their digits alone."""
    kinds = {n.rstrip("0123456789") for n in poses}
    return sorted(
        p.name for p in folder.iterdir()
        if p.is_dir() and p.name not in poses and p.name.rstrip("0123456789") in kinds
    )  # fmt: skip


def _projector(c: Capture) -> str:
    return f"{c.projector_width} x {c.projector_height} {c.layout.value}"


# --------------------------------------------------------------------------------------- observations in the rig's file


def pack(a: AnyArray, dtype: str) -> dict[str, Any]:
    """An array as JSON: little-endian samples, deflated, in base 64."""
    a = np.ascontiguousarray(a, dtype=np.dtype(dtype).newbyteorder("<"))
    data = base64.b64encode(zlib.compress(a.tobytes(), 6)).decode()
    return {"dtype": np.dtype(dtype).newbyteorder("<").str, "shape": list(a.shape), "deflate": data}


def unpack(d: Any, path: Path) -> AnyArray:
    """The array that `pack` wrote. Raises FormatError."""
    try:
        dtype, shape = np.dtype(str(d["dtype"])), tuple(int(n) for n in d["shape"])
        size = dtype.itemsize * int(np.prod(shape, dtype=np.int64))
        if dtype.kind not in "iuf" or min(shape, default=0) < 0 or size > MOST_BYTES:
            raise ValueError("not an array")
        data = zlib.decompressobj().decompress(base64.b64decode(d["deflate"], validate=True), size + 1)
        if len(data) != size:
            raise ValueError("another length")
        return np.frombuffer(data, dtype).reshape(shape).astype(dtype.newbyteorder("="))
    except (KeyError, TypeError, ValueError, zlib.error, binascii.Error) as e:
        raise FormatError(f"{path}: an array of the observations is damaged ({e}); calibrate anew") from None


_ARRAYS = {
    "corner": "i4", "corner_px": "f8", "corner_sigma": "f4", "square": "i4", "square_px": "f8", "square_uv": "f8",
    "square_sigma": "f4", "directions": "f8", "sample_px": "f8", "sample_phase": "f4", "sample_sigma": "f4",
}  # fmt: skip


def calibration_document(c: Calibration) -> dict[str, Any]:
    """What a rig file keeps of its calibration: board, observations, residuals, parameters, covariance."""
    return {
        "board": board_document(c.board),
        "calibration": {
            "noise": dict(c.noise),
            "figures": dict(c.figures),
            "left_out": [vars(x) for x in c.left_out],
            "parameters": [vars(p) for p in c.parameters],
            "covariance": pack(c.covariance, "f8"),
            "board_poses": {n: {"R": p.R.tolist(), "t": p.t.tolist()} for n, p in c.boards.items()},
            "residuals": [
                {"pose": r.pose, "camera": r.camera, **{k: pack(getattr(r, k), "f4") for k in ("corner", "sample")}}
                for r in c.residuals
            ],
        },
        "observations": [
            {
                "pose": s.pose, "camera": s.camera, "size": list(s.size), "words": list(s.words),
                **{k: pack(getattr(s, k), t) for k, t in _ARRAYS.items()},
            }
            for s in c.sightings
        ],
    }  # fmt: skip


def read_observations(path: Path | str) -> tuple[Board, tuple[Sighting, ...]]:
    """The board and the sightings that a rig's file carries, so that the solve can be repeated. Raises FormatError."""
    path = Path(path)
    doc = files.read_json(path, "a rig")
    if "observations" not in doc or "board" not in doc:
        raise FormatError(f"{path}: this rig carries no observations; give the folder of the board captures")
    board = parse_board(doc["board"], path)
    out = []
    try:
        for o in doc["observations"]:
            arrays: dict[str, Any] = {
                k: unpack(o[k], path).astype(np.int32 if t == "i4" else np.float64) for k, t in _ARRAYS.items()
            }
            w, h = o["size"]
            words = tuple(str(x) for x in o.get("words", ()))
            out.append(Sighting(pose=str(o["pose"]), camera=str(o["camera"]), size=(int(w), int(h)), words=words,
                                **arrays))  # fmt: skip
    except (KeyError, TypeError, ValueError, AttributeError) as e:
        raise FormatError(f"{path}: its observations are damaged ({e}); calibrate anew") from None
    return board, tuple(out)
