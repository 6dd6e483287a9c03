"""Events, effects and states as plain dictionaries, and back: for a log, or for a message."""

from __future__ import annotations

import dataclasses
import functools
import math
import types
import typing
from enum import Enum
from typing import Any

from fringescope.errors import FormatError
from fringescope.types import examination as words

_KINDS: dict[str, type] = {
    name: kind for name, kind in vars(words).items() if isinstance(kind, type) and dataclasses.is_dataclass(kind)
}


def to_dict(value: Any) -> dict[str, Any]:
    """An event, an effect, an outcome or a state as dictionaries, lists, strings and numbers, ready for JSON."""
    out = _plain(value)
    if not isinstance(out, dict):
        raise FormatError(f"{type(value).__name__}; needed an event, an effect or a state")
    return out


def from_dict(d: object) -> Any:
    """The value that `to_dict` was given. Unknown keys are left aside.

    Raises FormatError for a kind that there is not, and for what is missing or of another type.
    """
    kind = d.get("kind") if isinstance(d, dict) else None
    if not isinstance(d, dict) or not isinstance(kind, str) or kind not in _KINDS:
        raise FormatError(f"kind {str(kind)[:40]!r}; needed one of {', '.join(sorted(_KINDS))}")
    cls = _KINDS[kind]
    hints = _hints(cls)
    found: dict[str, Any] = {}
    for f in dataclasses.fields(cls):
        if f.name in d:
            found[f.name] = _typed(d[f.name], hints[f.name], f"{kind}.{f.name}")
        elif f.default is dataclasses.MISSING:
            raise FormatError(f"{kind} without '{f.name}'")
    return cls(**found)


@functools.cache
def _hints(cls: type) -> dict[str, Any]:
    return typing.get_type_hints(cls)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {"kind": type(value).__name__} | {
            f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)
        }
    if isinstance(value, Enum):
        return value.value
    return [_plain(v) for v in value] if isinstance(value, tuple) else value


def _typed(value: Any, hint: Any, where: str) -> Any:
    """A value as its annotation says."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in args:
            return None
        kinds = [a for a in args if a is not type(None)]
        if len(kinds) == 1:
            return _typed(value, kinds[0], where)
        made = from_dict(value)
        if type(made) not in kinds:
            raise FormatError(f"{where}: a {type(made).__name__} does not belong there")
        return made
    if origin is tuple:
        if not isinstance(value, (list, tuple)) or (args[-1] is not ... and len(value) != len(args)):
            of = "" if args[-1] is ... else f" of {len(args)}"
            raise FormatError(f"{where}: {str(value)[:40]!r}; needed a list{of}")
        each = [args[0]] * len(value) if args[-1] is ... else args
        return tuple(_typed(v, a, where) for v, a in zip(value, each, strict=True))
    if dataclasses.is_dataclass(hint):
        made = from_dict(value)
        if type(made) is not hint:
            raise FormatError(f"{where}: a {type(made).__name__} does not belong there")
        return made
    if issubclass(hint, Enum):
        try:
            return hint(value)
        except ValueError:
            raise FormatError(f"{where}: {str(value)[:40]!r}; needed {', '.join(e.value for e in hint)}") from None
    if hint is float and type(value) is int:
        return float(value)
    if type(value) is not hint or (hint is float and not math.isfinite(value)):
        raise FormatError(f"{where}: {str(value)[:40]!r}; needed a {hint.__name__}")
    return value
