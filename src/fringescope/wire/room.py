"""What goes through the room of a case, over one WebSocket: each message is one JSON object with its `type`."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from fringescope.wire.ops import Number, Op, Pixel, Word, World


class _Message(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


# ----------------------------------------------------------------------------------------------------- from the client


class Say(_Message):
    """An op for the log."""

    type: Literal["say"] = "say"
    op: Op


class Pointer(_Message):
    """Where somebody points, while they do: never kept."""

    type: Literal["pointer"] = "pointer"
    camera: Word | None = None
    pixel: Pixel | None = None
    world_mm: World | None = None


class View(_Message):
    """From where somebody looks at the surface: never kept."""

    type: Literal["view"] = "view"
    eye_mm: World
    target_mm: World
    up: World


class Ink(_Message):
    """A piece of a stroke that is being drawn: never kept; the finished one comes as an op."""

    type: Literal["ink"] = "ink"
    stroke: Word
    camera: Word | None = None
    points: Annotated[list[Annotated[list[Number], Field(min_length=2, max_length=3)]], Field(max_length=500)]
    color: Annotated[str, Field(max_length=20)] = "#ff3030"


class Ping(_Message):
    """Is anybody there?"""

    type: Literal["ping"] = "ping"
    at_ms: Annotated[float, Field(allow_inf_nan=False)] = 0


Ephemeral = Pointer | View | Ink
FromClient = Annotated[Say | Pointer | View | Ink | Ping, Field(discriminator="type")]

# ----------------------------------------------------------------------------------------------------- from the server


class Welcome(_Message):
    """The first message: who you are here, how far the log goes, who is in the room.

    `anew`: what you have is not in the log any more, as after a power cut; forget it, all events come again.
    """

    type: Literal["welcome"] = "welcome"
    person: Word
    role: Word
    local: bool
    seq: int
    present: list[str]
    anew: bool = False


class Event(_Message):
    """An event of the log, in its order and each once."""

    type: Literal["event"] = "event"
    seq: int
    at_ns: int
    actor: str
    role: str
    client: str
    number: int
    kind: str
    refused: str
    payload: dict[str, Any] | None
    hash: str


class CaughtUp(_Message):
    """All that was there when you came was sent."""

    type: Literal["caught_up"] = "caught_up"
    seq: int


class Said(_Message):
    """What became of your op: its event, or why there is none (`refused`, a sentence for the screen)."""

    type: Literal["said"] = "said"
    client: str
    number: int
    seq: int | None
    refused: str = ""


class Standing(_Message):
    """How far each version has come, and whether the specimen is still as it was scanned."""

    type: Literal["standing"] = "standing"
    seq: int
    state: dict[str, Any]


class Warned(_Message):
    """For the operator, with a sound."""

    type: Literal["warned"] = "warned"
    text: str


class Relayed(_Message):
    """What somebody else points at, sees or draws right now."""

    type: Literal["relayed"] = "relayed"
    person: str
    what: Annotated[Pointer | View | Ink, Field(discriminator="type")]


class Presence(_Message):
    """Who is in the room now."""

    type: Literal["presence"] = "presence"
    present: list[str]


class Pong(_Message):
    """Somebody is."""

    type: Literal["pong"] = "pong"
    at_ms: float


class Refusal(_Message):
    """A message that could not be taken, and why, in a sentence for the screen."""

    type: Literal["refusal"] = "refusal"
    why: str


FromServer = Annotated[
    Welcome | Event | CaughtUp | Said | Standing | Warned | Relayed | Presence | Pong | Refusal,
    Field(discriminator="type"),
]
