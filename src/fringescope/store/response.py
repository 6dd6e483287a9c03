"""response.json: the measured response of camera and projector, with its verdict and its table for the projector."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from fringescope.errors import FormatError
from fringescope.store.rig import read_model
from fringescope.store.scan import plain
from fringescope.types import Response

FORMAT, VERSION = "fringescope-response", 1


class _Response(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow", frozen=True, allow_inf_nan=False)
    source: str
    gamma: float = Field(gt=0, lt=100)
    gamma_sigma: float = Field(ge=0)
    harmonics: list[float] = Field(min_length=1, max_length=64)
    sigmas: list[float] = Field(min_length=1, max_length=64)
    blur: float = Field(default=0.0, ge=0, lt=1e4)
    levels: list[float] = Field(default=[0.0, 1.0], min_length=2, max_length=2)
    error_rad: dict[str, float] = Field(default={})
    error_sigma: dict[str, float] = Field(default={})
    pixels: int = 0
    saturated: float = 0.0
    needed: bool
    words: list[str] = Field(default=[])
    figures: dict[str, Any] = Field(default={})


def response_document(response: Response, predistortion: Sequence[int] = ()) -> dict[str, Any]:
    """The JSON object of a response; `predistortion` (256 levels) is the table that makes the projector linear."""
    doc = {"format": FORMAT, "version": VERSION, **plain(dataclasses.asdict(response))}
    return doc | ({"predistortion": [int(x) for x in predistortion]} if len(predistortion) else {})


def read_response(path: Path | str) -> Response:
    """The response in a file. Raises FormatError."""
    path = Path(path)
    m = read_model(path, "a response (response.json)", FORMAT, VERSION, _Response)
    if any(not k.isdigit() for k in (*m.error_rad, *m.error_sigma)) or max(map(abs, m.harmonics)) > 2:
        raise FormatError(f"{path}: harmonics beyond 2, or errors not by number of steps; measure the response again")
    try:
        return Response(
            m.source, m.gamma, m.gamma_sigma, tuple(m.harmonics), tuple(m.sigmas), m.blur, (m.levels[0], m.levels[1]),
            {int(k): v for k, v in m.error_rad.items()}, {int(k): v for k, v in m.error_sigma.items()},
            m.pixels, m.saturated, m.needed, tuple(m.words), m.figures,
        )  # fmt: skip
    except FormatError as e:
        raise FormatError(f"{path}: {e}") from None
