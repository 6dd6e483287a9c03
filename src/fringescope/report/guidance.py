"""Guidance over photographs: how the projected lines will look in each camera, and which parts stay dark."""

from __future__ import annotations

import textwrap

import cv2
import numpy as np

from fringescope import geometry
from fringescope.types import F32, F64, U8, AnyArray, Camera, Guidance, Guided, Landing, Layout, Projector

WIDE = 1400  #: pixels of a preview at most
LINE = 26  #: height of a line of its caption
ROWS = 3  #: lines of the caption that one stroke may take
HIDDEN_COLOUR = (255, 176, 0)
GAIN = 3.0  #: how much brighter than the ring light the lamps of the projector look


def guidance_preview(
    photo: F32, uv: F64, camera: Camera, projector: Projector, guidance: Guidance, wide: int = WIDE
) -> U8:
    """The photograph with the light of the projected lines on it; (h, w, 3) RGB, at most `wide` pixels wide.

    `photo` (H, W, 3) linear light, `uv` (H, W, 2) where each pixel's place lies on the projector's plane, NaN = not
    measured. Parts of strokes that stay dark are dotted, and a caption tells how much that is.
    """
    scale = min(1.0, wide / photo.shape[1])
    size = (max(1, round(photo.shape[1] * scale)), max(1, round(photo.shape[0] * scale)))
    picture = cv2.resize(photo, size, interpolation=cv2.INTER_AREA) if scale < 1 else photo.copy()
    v, u = np.meshgrid(*(np.minimum(((np.arange(n) + 0.5) / scale).astype(np.intp), m - 1)
                         for n, m in zip(size[::-1], photo.shape[:2], strict=True)), indexing="ij")  # fmt: skip
    at = uv[v, u].astype(np.float32)
    lamps = plane_light(guidance.image, projector)
    known = np.isfinite(at).all(-1)
    at[~known] = -10
    light = cv2.remap(lamps, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    light[~known] = 0
    grey = picture.mean(axis=2, keepdims=True)
    out = _srgb(0.75 * picture + GAIN * light * (0.7 * picture + 0.3 * grey + 0.04))
    _dot_hidden(out, guidance, camera, scale)
    return _captioned(out, [caption(g) for g in guidance.strokes])


def plane_light(image: U8, projector: Projector) -> F32:
    """A device picture (height, width, 3) as light on the projector's plane (h, w, 3), 0..1."""
    light = image.astype(np.float32) / np.float32(255)
    if projector.layout is Layout.GRID:
        return np.asarray(light, np.float32)
    h, w = light.shape[:2]
    out = np.zeros((h, 2 * w, 3), np.float32)
    out[0::2, 0::2] = light[0::2]
    out[1::2, 1::2] = light[1::2]
    around = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]], np.float32) / 4
    return np.asarray(cv2.filter2D(out, -1, around, borderType=cv2.BORDER_REPLICATE), np.float32)


def caption(g: Guided) -> str:
    """One line on a stroke, for people."""
    if g.refused is not None:
        return f"{g.stroke.id}: not shown: {g.refused}"
    parts = [f"{g.stroke.id}: {g.length_mm:.1f} mm"] if g.length_mm else [g.stroke.id + ":"]
    if g.area_mm2 is not None:
        parts.append(f"{g.area_mm2:.1f} mm2")
    why: dict[str, float] = {}
    for h in g.hidden:
        why[h.why.value] = why.get(h.why.value, 0.0) + h.length_mm
    dark = {k: mm for k, mm in why.items() if mm >= 0.05}
    parts += [f"{mm:.1f} mm dark ({k})" for k, mm in dark.items()] or ["all of it visible"]
    if g.expected_error_um is not None:
        parts.append(f"expected error {g.expected_error_um:.0f} um")
    return ", ".join(parts)


def landing_caption(x: Landing) -> str:
    """One line on where a stroke landed, for people."""
    if x.median_um is None:
        return "; ".join(("not found", *x.words))
    told = f"median {x.median_um:.0f}, p95 {x.p95_um:.0f}, max {x.max_um:.0f} um from where it was asked for"
    return "; ".join((told, *x.words))


def landing_picture(photo: F32, camera: Camera, index: int, landings: tuple[Landing, ...], wide: int = WIDE) -> U8:
    """Where the lines were found, over a picture taken while they were projected; (h, w, 3) RGB.

    `photo` (H, W, 3) linear light of camera number `index`. A green dot is a place where a line was found; the red bar
    at it shows its offset from the asked line, enlarged as the caption says.
    """
    worst = max((x.p95_um for x in landings if x.p95_um is not None), default=0.0)
    times = next((t for t in (200, 100, 50, 20, 10, 5, 2) if t * worst <= 2000), 1)
    scale = min(1.0, wide / photo.shape[1])
    size = (max(1, round(photo.shape[1] * scale)), max(1, round(photo.shape[0] * scale)))
    out = _srgb(cv2.resize(photo, size, interpolation=cv2.INTER_AREA) if scale < 1 else photo.copy())
    lines = []
    for one in landings:
        mine = one.camera == index
        found = geometry.project(camera, one.found[mine]) * scale
        asked = geometry.project(camera, one.asked[mine]) * scale
        for p, q in zip(found, asked, strict=True):
            if np.isfinite([*p, *q]).all():
                _line(out, q, q + times * (p - q), (255, 64, 64), 1)
                cv2.circle(out, (round(p[0] * 16), round(p[1] * 16)), 24, (64, 255, 96), -1, cv2.LINE_AA, 4)
        lines.append(f"{one.id}: {landing_caption(one)}")
    return _captioned(out, [f"red: offset, {times} times as large", *lines])


def _srgb(light: AnyArray) -> U8:
    a = np.clip(light, 0, 1)
    return np.asarray(255 * np.where(a <= 0.0031308, 12.92 * a, 1.055 * a ** (1 / 2.4) - 0.055) + 0.5, np.uint8)


def _dot_hidden(out: U8, guidance: Guidance, camera: Camera, scale: float) -> None:
    """Dots along the parts of strokes that are not shown."""
    for g in guidance.strokes:
        for t in g.traces:
            k = np.flatnonzero((t.why != 0) & np.isfinite(t.xyz).all(1))
            p = geometry.project(camera, t.xyz[k]) * scale
            last: F64 | None = None
            for q in p[np.isfinite(p).all(1)]:
                if last is None or np.linalg.norm(q - last) >= 6:
                    cv2.circle(out, (round(q[0] * 16), round(q[1] * 16)), 28, HIDDEN_COLOUR, -1, cv2.LINE_AA, 4)
                    last = q


def _line(out: U8, a: F64, b: F64, colour: tuple[int, int, int], wide: int) -> None:
    ends = [(round(float(p[0]) * 16), round(float(p[1]) * 16)) for p in (a, b)]
    cv2.line(out, ends[0], ends[1], colour, wide, cv2.LINE_AA, 4)


def _captioned(picture: U8, lines: list[str], most: int = 12) -> U8:
    """The picture with lines of words under it; long ones go on, indented, on the next line."""
    shown = lines[:most] + ([f"and {len(lines) - most} more"] if len(lines) > most else [])
    room = max(10, int((picture.shape[1] - 20) / 9.2))
    rows: list[str] = []
    for words in shown:
        plain = words.encode("ascii", "replace").decode()
        rows += textwrap.wrap(plain, room, subsequent_indent="    ", max_lines=ROWS, placeholder=" ..")
    strip = np.full((LINE * len(rows) + 10, picture.shape[1], 3), 24, np.uint8)
    for i, row in enumerate(rows):
        cv2.putText(strip, row, (10, LINE * (i + 1)), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (235, 235, 235), 1, cv2.LINE_AA)
    return np.vstack([picture, strip])
