"""What people say for good: each op becomes one event of a case's log, or is refused with a sentence for the screen."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

WORD = r"^[^\x00-\x1f\x7f]{1,200}$"  #: identifiers, hashes and names
POINTS = 5000  #: of one stroke at most
TEXT = 4000  #: letters of a comment or note at most

Word = Annotated[str, Field(pattern=WORD)]
Number = Annotated[float, Field(allow_inf_nan=False, ge=-1e6, le=1e6)]
Pixel = tuple[Number, Number]
World = tuple[Number, Number, Number]


class _Said(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class StrokeDocument(_Said):
    """One stroke as in a guidelines file: in pixels (n, 2) of a camera, or at world_mm (n, 3)."""

    id: Word
    kind: Literal["line", "region", "circle", "arrow", "offsets", "text"] = "line"
    camera: Word | None = None
    pixels: Annotated[list[Pixel], Field(min_length=1, max_length=POINTS)] | None = None
    world_mm: Annotated[list[World], Field(min_length=1, max_length=POINTS)] | None = None
    width_mm: Annotated[float, Field(ge=0.01, le=20)] | None = None
    width_px: Annotated[float, Field(ge=0.1, le=200)] | None = None
    color: Annotated[str, Field(max_length=20)] = "#ff3030"
    closed: bool = False
    fill: Literal["none", "solid", "hatch"] = "none"
    spacing_mm: Annotated[float, Field(ge=0.1, le=100)] = 2.0
    count: Annotated[int, Field(ge=1, le=100)] = 1
    side: Literal["left", "right", "both"] = "right"
    radius_mm: Annotated[float, Field(ge=0.05, le=200)] | None = None
    head_mm: Annotated[float, Field(ge=0.1, le=50)] | None = None
    text: Annotated[str, Field(max_length=100)] = ""
    size_mm: Annotated[float, Field(ge=0.5, le=50)] = 3.0


class Put(_Said):
    """A stroke drawn, or changed by its author; `meaning` is what it stands for."""

    kind: Literal["put"] = "put"
    stroke: StrokeDocument
    scan: Word
    layer: Annotated[str, Field(max_length=200)] = ""
    meaning: Literal["cut", "avoid", "sample", "margin", "ink", "note"] = "cut"


class Remove(_Said):
    """The author takes a stroke out of their draft."""

    kind: Literal["remove"] = "remove"
    stroke: Word


class Layer(_Said):
    """A layer is made, renamed or hidden for everybody, by its author."""

    kind: Literal["layer"] = "layer"
    layer: Word
    name: Annotated[str, Field(max_length=200)]
    hidden: bool = False


class Comment(_Said):
    """Words for the others, about a stroke, a version, a place (world mm) or nothing in particular."""

    kind: Literal["comment"] = "comment"
    comment: Word
    text: Annotated[str, Field(min_length=1, max_length=TEXT)]
    stroke: Word | None = None
    version: int | None = None
    place_mm: World | None = None


class Withdraw(_Said):
    """The author takes a comment back; the log keeps that it was there."""

    kind: Literal["withdraw"] = "withdraw"
    comment: Word


class Undo(_Said):
    """The author takes back what event `of` did; None: their last op that can be. An undo of an undo does it again."""

    kind: Literal["undo"] = "undo"
    of: Annotated[int, Field(ge=1)] | None = None


class Submit(_Said):
    """The author asks for exactly these strokes, identifier and content each, on this scan and rig."""

    kind: Literal["submit"] = "submit"
    strokes: Annotated[list[tuple[Word, Word]], Field(min_length=1, max_length=1000)]
    scan: Word
    rig: Word


class Sign(_Said):
    """A person signs a version: name, time and meaning are bound to its content. Needs the password again."""

    kind: Literal["sign"] = "sign"
    version: int
    content: Word
    meaning: Literal["proposed", "approved", "done as drawn", "not done"]


class Preview(_Said):
    """The operator, at the instrument, asks to see how a version will look, before they arm it."""

    kind: Literal["preview"] = "preview"
    version: int


class Arm(_Said):
    """The operator, at the instrument, confirms what the preview showed."""

    kind: Literal["arm"] = "arm"
    version: int
    content: Word
    pattern: Word


class Start(_Said):
    """The operator, at the instrument, turns on the light."""

    kind: Literal["start"] = "start"
    version: int
    pattern: Word


class Acknowledge(_Said):
    """The operator goes on although the specimen has been suspect since then, `suspect` of the standing: a browser's
    numbers cannot hold its nanoseconds.
    """

    kind: Literal["acknowledge"] = "acknowledge"
    suspect: Annotated[str, Field(pattern=r"^[0-9]{1,19}$")]


class Stop(_Said):
    """Dark: one version, or whatever is armed or projected. Anybody, from anywhere, at any time."""

    kind: Literal["stop"] = "stop"
    version: int | None = None
    why: Annotated[str, Field(max_length=200)] = ""


class CarryOver(_Said):
    """The operator takes the strokes of a stale version over to the present scan, as job `job` has laid them there."""

    kind: Literal["carry_over"] = "carry_over"
    version: int
    scan: Word
    job: Word


Said = Annotated[
    Put | Remove | Layer | Comment | Withdraw | Undo | Submit | Sign | Preview | Arm | Start | Acknowledge | Stop
    | CarryOver,
    Field(discriminator="kind"),
]  # fmt: skip


class Op(_Said):
    """The `number`-th op (1, 2, ..) of `client`, which is one program from its start to its end.

    Said twice it is done once: the second time the answer of the first comes back.
    """

    client: Annotated[str, Field(pattern=r"^[A-Za-z0-9._:-]{1,64}$")]
    number: Annotated[int, Field(ge=1, le=2**53)]
    at_ns: Annotated[int, Field(ge=0, lt=2**63)] = 0
    what: Said


DARK = ("stop",)
#: what only somebody standing at the instrument may say
LOCAL = ("preview", "arm", "start", "acknowledge")
