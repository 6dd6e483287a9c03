"""Clouds as binary little-endian PLY, in the layout of docs/formats.md."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from fringescope.errors import FormatError
from fringescope.types import AnyArray, Cloud

Target = str | Path | BinaryIO

_FIELDS = (("x", "<f4", "float"), ("y", "<f4", "float"), ("z", "<f4", "float"), ("nx", "<f4", "float"),
           ("ny", "<f4", "float"), ("nz", "<f4", "float"), ("red", "u1", "uchar"), ("green", "u1", "uchar"),
           ("blue", "u1", "uchar"), ("sigma", "<f4", "float"), ("view", "u1", "uchar"))
_RECORD = np.dtype([(name, kind) for name, kind, _ in _FIELDS])
_KINDS = {"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "u1", "uint8": "u1",
          "char": "i1", "int8": "i1", "short": "<i2", "int16": "<i2", "ushort": "<u2", "uint16": "<u2", "int": "<i4",
          "int32": "<i4", "uint": "<u4", "uint32": "<u4"}
_CHUNK = 1 << 20  # points packed at a time


@contextlib.contextmanager
def opened(target: Target) -> Iterator[BinaryIO]:
    """The file object itself, or the path opened for writing."""
    if isinstance(target, (str, Path)):
        with Path(target).open("wb") as f:
            yield f
    else:
        yield target


def write_ply(cloud: Cloud, target: Target, comment: str = "") -> None:
    """Write a cloud: float x y z nx ny nz (mm), uchar red green blue (sRGB), float sigma (mm), uchar view.

    `target` is a path or a binary file object; a `comment` goes into the header, line breaks in it become spaces.
    """
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {' '.join(comment.split())}"] if comment else []
    lines += [f"element vertex {len(cloud)}", *(f"property {kind} {name}" for name, _, kind in _FIELDS), "end_header\n"]
    with opened(target) as f:
        f.write("\n".join(lines).encode("ascii", "replace"))
        for i in range(0, len(cloud), _CHUNK):
            f.write(records(cloud, i, i + _CHUNK).tobytes())


def records(cloud: Cloud, first: int = 0, last: int | None = None) -> AnyArray:
    """Points first to last as packed records of the PLY layout."""
    part = slice(first, last)
    out = np.empty(len(cloud.xyz[part]), _RECORD)
    for columns, values in ((("x", "y", "z"), cloud.xyz), (("nx", "ny", "nz"), cloud.normals),
                            (("red", "green", "blue"), cloud.rgb)):
        for c, name in enumerate(columns):
            out[name] = values[part, c]
    out["sigma"], out["view"] = cloud.sigma[part], cloud.view[part]
    return out


def read_ply(path: str | Path) -> Cloud:
    """Read a binary little-endian PLY with at least x, y, z among its vertex properties, in any order.

    What is missing becomes: normals NaN, colours 255, sigma NaN, view 0. Elements before the vertices are refused.
    Raises FormatError if the file is no such PLY or truncated.
    """
    path = Path(path)
    with path.open("rb") as f:
        count, fields = _header(f, path)
        kind = np.dtype(fields)
        body = f.read(kind.itemsize * count)
    if len(body) < kind.itemsize * count:
        raise FormatError(f"{path}: truncated, {len(body)} bytes of points, needed {kind.itemsize * count}")
    v = np.frombuffer(body, kind)
    names = kind.names or ()

    def columns(wanted: tuple[str, ...], dtype: str, missing: float) -> AnyArray:
        if set(wanted) <= set(names):
            return np.stack([v[n] for n in wanted], axis=1).astype(dtype)
        return np.full((count, len(wanted)), missing, dtype)

    return Cloud(columns(("x", "y", "z"), "f4", np.nan), columns(("nx", "ny", "nz"), "f4", np.nan),
                 columns(("red", "green", "blue"), "u1", 255), columns(("sigma",), "f4", np.nan)[:, 0],
                 columns(("view",), "u1", 0)[:, 0])


def _header(f: BinaryIO, path: Path) -> tuple[int, list[tuple[str, str]]]:
    """Number of vertices and their properties; the file stands at the first of them."""
    if f.readline(16).strip() != b"ply":
        raise FormatError(f"{path}: not a PLY file; it does not begin with 'ply'")
    count, fields, element, binary = -1, list[tuple[str, str]](), "", False
    while True:
        raw = f.readline(4096)
        words = raw.decode("ascii", "replace").split()
        if not raw or f.tell() > 100_000:
            raise FormatError(f"{path}: a PLY header without 'end_header'")
        if words == ["end_header"]:
            break
        try:
            if words[:1] == ["format"]:
                binary = words[1] == "binary_little_endian"
            elif words[:1] == ["element"]:
                element = words[1]
                if element == "vertex":
                    count = int(words[2])
                elif count < 0:
                    raise FormatError(f"{path}: element '{element}' before the vertices; needed the vertices first")
            elif words[:1] == ["property"] and element == "vertex":
                fields.append((words[2], _KINDS[words[1]]))
        except (IndexError, KeyError, ValueError) as e:
            raise FormatError(f"{path}: header line '{' '.join(words)}' is not one that this reader knows") from e
    if not binary:
        raise FormatError(f"{path}: not a binary little-endian PLY; convert it")
    if count < 0 or not {"x", "y", "z"} <= {n for n, _ in fields} or len({n for n, _ in fields}) != len(fields):
        raise FormatError(f"{path}: vertices with {[n for n, _ in fields]}; needed x, y, z, each property once")
    return count, fields
