"""Raw frames as PNG and TIFF: reading with every check that a frame can fail, and writing.

A frame is (H, W) uint8 or uint16 (RGB8: (H, W, 3)), raw as the sensor gave it; more than 8 bits lie in 16-bit files,
right-aligned. `file.tif#3` names page 3 of a multi-page TIFF, counted from 0. A mono or Bayer frame that comes with
three identical channels is taken as one.
"""

from __future__ import annotations

import hashlib
import io
import logging
import re
import stat
import struct
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from fringescope.errors import CaptureError
from fringescope.types import AnyArray, PixelFormat

if TYPE_CHECKING:  # most frames are PNG
    import tifffile

_PNG = b"\x89PNG\r\n\x1a\n"
_TIFF = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
_PAGE = re.compile(r"^(.+\.tiff?)#(\d{1,6})$", re.IGNORECASE)
_MAX_PIXELS = 1 << 30
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}


class Header(NamedTuple):
    """What a frame's file says of itself: size in pixels, channels, bits per sample as stored."""

    width: int
    height: int
    channels: int
    bits: int


class Plain(NamedTuple):
    """Samples (H, W) that lie in a file as they are."""

    path: Path
    offset: int
    height: int
    width: int
    dtype: np.dtype[Any]  #: with its order of bytes

    def rows(self, first: int, last: int) -> AnyArray:
        """Rows first to last - 1, read now, in the order of bytes of the machine. Raises CaptureError."""
        last = min(last, self.height)
        at = self.offset + first * self.width * self.dtype.itemsize
        try:
            out = np.fromfile(self.path, self.dtype, max(last - first, 0) * self.width, offset=at)
        except OSError as e:
            raise CaptureError(f"{self.path}: cannot read: {e.strerror or e}") from e
        if out.size != max(last - first, 0) * self.width:
            raise CaptureError(f"{self.path}: truncated; needed a frame that stays as it is")
        return out.astype(self.dtype.newbyteorder("="), copy=False).reshape(-1, self.width)


def split_page(name: str) -> tuple[str, int | None]:
    """ "file.tif#3" to ("file.tif", 3); any other name to (name, None)."""
    m = _PAGE.match(name)
    return (m[1], int(m[2])) if m else (name, None)


class _Complaints(logging.Handler):
    """What tifffile only logs about a damaged file becomes an error, and none of it reaches stderr."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.thread = threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        """Remembers the first complaint of this thread by raising it."""
        if threading.get_ident() == self.thread:
            raise ValueError(record.getMessage().partition("> ")[2] or record.getMessage())


@contextmanager
def _strict() -> Iterator[None]:
    logger = logging.getLogger("tifffile")
    handler, passes = _Complaints(), logger.propagate
    logger.addHandler(handler)
    logger.propagate = False
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.propagate = passes


@contextmanager
def quiet() -> Iterator[None]:
    """OpenCV keeps what it thinks of a damaged file to itself: the one line about it is ours."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


def _regular(path: Path) -> None:
    """Refuses what is there but no file, before it is opened: a pipe would wait for ever. Raises CaptureError."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return  # who opens it says why
    if not stat.S_ISREG(mode):
        came = "a folder" if stat.S_ISDIR(mode) else "a pipe or a device"
        raise CaptureError(f"{path}: is {came}; needed a PNG or TIFF frame: copy the file itself there")


class Images:
    """The image files of one folder, read one at a time; keeps each file's sha256 as it goes by.

    One multi-page TIFF stays in memory while its pages are asked for in turn.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.digests: dict[str, str] = {}
        self._stack: tuple[str, tifffile.TiffFile] | None = None

    def _bytes(self, file: str) -> bytes:
        path = self.folder / file
        _regular(path)
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            raise CaptureError(f"{path}: frame is missing; capture.json names it") from None
        except (OSError, ValueError) as e:
            raise CaptureError(f"{path}: cannot read: {getattr(e, 'strerror', None) or e}") from e
        if not data:
            raise CaptureError(f"{path}: is empty (0 bytes); needed a PNG or TIFF frame")
        self.digests[file] = hashlib.sha256(data).hexdigest()
        return data

    def digest(self, name: str) -> str:
        """sha256 of the file of a frame, hexadecimal. Raises CaptureError if it cannot be read."""
        file, _ = split_page(name)
        if file not in self.digests:
            self._bytes(file)
        return self.digests[file]

    def header(self, name: str) -> Header:
        """What the frame `name` says of itself, without decoding it. Raises CaptureError if it is no PNG or TIFF."""
        file, page = split_page(name)
        path = self.folder / file
        _regular(path)
        try:
            with path.open("rb") as f:
                start = f.read(33)
        except FileNotFoundError:
            raise CaptureError(f"{path}: frame is missing; capture.json names it") from None
        except (OSError, ValueError) as e:
            raise CaptureError(f"{path}: cannot read: {getattr(e, 'strerror', None) or e}") from e
        if start.startswith(_PNG) and len(start) == 33 and start[12:16] == b"IHDR":
            w, h, bits, kind = struct.unpack(">IIBB", start[16:26])
            head = Header(w, h, _PNG_CHANNELS.get(kind, 0), bits)
        elif start[:4] in _TIFF:
            head = _tiff_header(self._page(file, page), path)
        else:
            raise CaptureError(f"{path}: {_not_an_image(start)}; needed a PNG or TIFF frame")
        if not (head.width > 0 and head.height > 0 and head.width * head.height <= _MAX_PIXELS):
            raise CaptureError(f"{path}: size {head.width} x {head.height}; needed 1 to {_MAX_PIXELS} pixels")
        return head

    def raw(self, name: str) -> AnyArray:
        """The samples as stored: (H, W) or (H, W, channels), RGB order. Raises CaptureError if they cannot be had."""
        file, page = split_page(name)
        path = self.folder / file
        if self._stack is not None and self._stack[0] == file:
            return _tiff_array(self._page(file, page), path)
        self._stack = None
        data = self._bytes(file)
        if data.startswith(_PNG):
            return decode_png(data, path)
        if data[:4] in _TIFF:
            return _tiff_array(self._page(file, page, data), path)
        raise CaptureError(f"{path}: {_not_an_image(data)}; needed a PNG or TIFF frame")

    def array(self, name: str) -> AnyArray:
        """An array that we wrote ourselves as TIFF or PNG, floats too. Raises CaptureError if it cannot be had."""
        if name.endswith(".png"):
            return self.raw(name)
        return _tiff_array(self._page(name, None), self.folder / name, "uif")

    def frame(self, name: str, pixel_format: PixelFormat, size: tuple[int, int] | None = None) -> AnyArray:
        """One frame, checked against its pixel format and, where given, the (width, height) of its view.

        Returns (H, W) or for RGB8 (H, W, 3), uint8 or uint16. Raises CaptureError.
        """
        path = self.folder / name
        return check_frame(self.raw(name), pixel_format, size, str(path))

    def plain(self, name: str) -> Plain | None:
        """Where the samples (H, W) of a frame lie in its file, row after row; None where they lie there in any other
        way, or cannot be had.
        """
        import tifffile

        file, page = split_page(name)
        path = self.folder / file
        try:
            _regular(path)
            with path.open("rb") as f:
                if f.read(4) not in _TIFF:
                    return None
            with _strict(), tifffile.TiffFile(path) as tif:
                one = tif.pages[page or 0]
                if not isinstance(one, tifffile.TiffPage) or not one.is_memmappable or one.samplesperpixel != 1:
                    return None
                out = Plain(
                    path, one.dataoffsets[0], one.imagelength, one.imagewidth,
                    np.dtype(one.dtype).newbyteorder(tif.byteorder),
                )  # fmt: skip
            whole = out.offset + out.height * out.width * out.dtype.itemsize <= path.stat().st_size
            return out if whole and out.dtype.kind == "u" else None
        except Exception:  # whoever reads it whole says what is wrong with it
            return None

    def _page(self, file: str, page: int | None, data: bytes | None = None) -> tifffile.TiffPage:
        import tifffile

        path = self.folder / file
        if self._stack is None or self._stack[0] != file:
            try:
                with _strict():
                    self._stack = (file, tifffile.TiffFile(io.BytesIO(self._bytes(file) if data is None else data)))
            except CaptureError:
                raise
            except Exception as e:
                raise CaptureError(f"{path}: truncated or unreadable TIFF ({_first_line(e)})") from e
        tif = self._stack[1]
        try:
            with _strict():
                n = len(tif.pages)
            if n == 0:
                raise CaptureError(f"{path}: a TIFF without pages; needed a frame")
            if page is None and n > 1:
                raise CaptureError(f'{path}: holds {n} pages; say which: "{file}#0" to "{file}#{n - 1}"')
            if (page or 0) >= n:
                raise CaptureError(f"{path}#{page}: the file has {n} pages (0 to {n - 1}); that page is missing")
            got = tif.pages[page or 0]
            return got if isinstance(got, tifffile.TiffPage) else got.aspage()
        except CaptureError:
            raise
        except Exception as e:
            raise CaptureError(f"{path}: truncated or unreadable TIFF ({_first_line(e)})") from e


def stack_axes(path: Path) -> tuple[dict[str, int], int]:
    """Sizes of a TIFF stack's axes other than x, y and samples, slowest first, as in {"T": 50, "Z": 3}; and its pages.

    Raises CaptureError if it is no TIFF.
    """
    import tifffile

    _regular(path)
    try:
        with _strict(), tifffile.TiffFile(path) as tif:
            series = tif.series[0]
            axes = dict(zip(series.axes, series.shape, strict=True))
            return {a: n for a, n in axes.items() if a not in "YXS"}, len(tif.pages)
    except FileNotFoundError:
        raise CaptureError(f"{path}: not found; needed a folder of images or a TIFF stack") from None
    except Exception as e:
        raise CaptureError(f"{path}: truncated or unreadable TIFF ({_first_line(e)})") from e


def _first_line(e: BaseException) -> str:
    lines = str(e).splitlines()
    return lines[0][:120] if lines else type(e).__name__


def _not_an_image(data: bytes) -> str:
    if data.startswith(_PNG):
        return "truncated PNG"
    if data.startswith(b"\xff\xd8"):
        return "is a JPEG, which loses what phase needs"
    if data.startswith(b"BM"):
        return "is a BMP (`fringescope import` takes it)"
    return "not an image that we read"


def _tiff_header(page: tifffile.TiffPage, path: Path, kinds: str = "u") -> Header:
    if page.dtype is None or page.dtype.kind not in kinds:
        raise CaptureError(f"{path}: samples of type {page.dtype}; needed unsigned 8 or 16 bits")
    told = (page.imagewidth, page.imagelength, page.samplesperpixel, page.bitspersample)
    if not all(isinstance(n, int) for n in told):  # a damaged tag
        raise CaptureError(f"{path}: truncated or unreadable TIFF (size {told})")
    return Header(*told)


def _lzw(page: tifffile.TiffPage) -> AnyArray:
    """LZW, for which tifffile would need another package."""
    handle = page.parent.filehandle
    handle.seek(0)
    data, which = np.frombuffer(handle.read(), np.uint8), (page.index, page.index + 1)
    with quiet():
        ok, pages = cv2.imdecodemulti(data, cv2.IMREAD_UNCHANGED, range=which)
    if not ok or not pages:
        raise ValueError("LZW data cannot be decoded")
    a: AnyArray = pages[0]
    return a if a.ndim == 2 else np.ascontiguousarray(a[..., ::-1])


def _tiff_array(page: tifffile.TiffPage, path: Path, kinds: str = "u") -> AnyArray:
    import tifffile

    head = _tiff_header(page, path, kinds)
    try:
        with _strict():
            lzw = page.compression == tifffile.COMPRESSION.LZW
            a: AnyArray = np.asarray(_lzw(page) if lzw else page.asarray())
    except Exception as e:
        if "imagecodecs" in str(e):
            how = tifffile.COMPRESSION(page.compression).name
            raise CaptureError(f"{path}: TIFF compressed as {how}; save it uncompressed or as deflate") from e
        raise CaptureError(f"{path}: truncated or unreadable TIFF ({_first_line(e)})") from e
    if a.ndim == 3 and a.shape[0] == head.channels and a.shape[-1] != head.channels:
        a = np.moveaxis(a, 0, -1)
    if a.shape[:2] != (head.height, head.width):
        raise CaptureError(f"{path}: a TIFF of {a.shape}; needed pages of height x width")
    return np.ascontiguousarray(a.astype(a.dtype.newbyteorder("="), copy=False))


def decode_png(data: bytes, path: Path) -> AnyArray:
    """A PNG's samples, (H, W) or (H, W, channels) in RGB order; each chunk is checked, since decoders forgive."""
    pos, done = len(_PNG), False
    while pos + 12 <= len(data) and not done:
        length, kind = struct.unpack(">I4s", data[pos : pos + 8])
        end = pos + 12 + length
        if end > len(data):
            break
        if zlib.crc32(data[pos + 4 : end - 4]) != struct.unpack(">I", data[end - 4 : end])[0]:
            raise CaptureError(f"{path}: damaged PNG (checksum of {kind!r} differs); copy it again from the camera")
        pos, done = end, kind == b"IEND"
    if not done:
        raise CaptureError(f"{path}: truncated PNG ({len(data)} bytes, no end); copy it again from the camera")
    w, h, bits = struct.unpack(">IIB", data[16:25])
    if w * h > _MAX_PIXELS:
        raise CaptureError(f"{path}: size {w} x {h}; needed 1 to {_MAX_PIXELS} pixels")
    if bits < 8:
        raise CaptureError(f"{path}: {bits}-bit PNG; needed 8 or 16 bits")
    try:
        with quiet():
            a = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as e:
        raise CaptureError(f"{path}: unreadable PNG ({_first_line(e)})") from e
    if a is None or a.shape[:2] != (h, w):
        raise CaptureError(f"{path}: unreadable PNG; copy it again from the camera")
    if a.ndim == 3 and a.shape[2] == 3:
        a = a[:, :, ::-1]
    elif a.ndim == 3 and a.shape[2] == 4:
        a = a[:, :, [2, 1, 0, 3]]
    out: AnyArray = np.ascontiguousarray(a)
    return out


def check_header(head: Header, fmt: PixelFormat, size: tuple[int, int] | None, name: str) -> None:
    """Refuses a frame by what its file says of itself. Raises CaptureError."""
    need = 8 if fmt.bits <= 8 else 16
    if head.bits != need:
        came = f"{head.bits}-bit file"
        raise CaptureError(f'{name}: {came}; {fmt.value} needs {need} bits: mend "pixel_format" or the file')
    if head.channels not in (1, 3) or (fmt is PixelFormat.RGB8 and head.channels != 3):
        need_c = 3 if fmt is PixelFormat.RGB8 else 1
        raise CaptureError(f"{name}: {head.channels} channels; {fmt.value} needs {need_c}")
    if size is not None and (head.width, head.height) != size:
        came, need_size = f"{head.width} x {head.height}", f"{size[0]} x {size[1]}"
        raise CaptureError(f"{name}: {came} pixels; the view's other frames have {need_size}")


def check_frame(a: AnyArray, fmt: PixelFormat, size: tuple[int, int] | None, name: str) -> AnyArray:
    """Samples as stored to a frame of `fmt`; three identical channels become one. Raises CaptureError naming `name`."""
    if a.ndim not in (2, 3):
        raise CaptureError(f"{name}: an array of shape {a.shape}; needed height x width")
    channels = 1 if a.ndim == 2 else a.shape[2]
    check_header(Header(a.shape[1], a.shape[0], channels, 8 * a.dtype.itemsize), fmt, size, name)
    if fmt is not PixelFormat.RGB8 and channels == 3:
        if not ((a[..., 0] == a[..., 1]).all() and (a[..., 0] == a[..., 2]).all()):
            raise CaptureError(f"{name}: a colour picture; {fmt.value} needs raw samples in one channel")
        a = np.ascontiguousarray(a[..., 0])
    if fmt.bits > 8 and fmt.bits < 16:
        top = int(a.max())
        if top > fmt.max_value:
            shift = 16 - fmt.bits
            hint = 'mend "pixel_format" or the file'
            if not (a & ((1 << shift) - 1)).any():
                hint = f"they look left-aligned: shift them right by {shift} (`fringescope import --left-aligned`)"
            raise CaptureError(f"{name}: values up to {top}; {fmt.value} goes to {fmt.max_value}: {hint}")
    return a


# ------------------------------------------------------------------------------------------------------------ writing


def write_png(path: Path, a: AnyArray, level: int = 1) -> None:
    """(H, W) or (H, W, 3) RGB, uint8 or uint16, as PNG. Raises OSError if it cannot be written."""
    bgr: Any = a[:, :, ::-1] if a.ndim == 3 else a
    ok, data = cv2.imencode(".png", np.ascontiguousarray(bgr), [cv2.IMWRITE_PNG_COMPRESSION, level])
    if not ok:
        raise OSError(f"cannot encode a PNG of shape {a.shape} {a.dtype}")
    path.write_bytes(data.tobytes())


def write_tiff(path: Path, a: AnyArray) -> None:
    """(H, W) or (H, W, 3) float32 or integers as an uncompressed TIFF. Raises OSError if it cannot be written."""
    import tifffile

    buf = io.BytesIO()
    tifffile.imwrite(
        buf,
        a,
        photometric="rgb" if a.ndim == 3 and a.dtype == np.uint8 else "minisblack",
        metadata=None,
        planarconfig="contig" if a.ndim == 3 else None,
    )
    path.write_bytes(buf.getbuffer())
