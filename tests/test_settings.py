"""The settings tree: frozen, with units and ranges, and the same after a trip through YAML."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from fringescope import settings as fs
from fringescope.errors import UsageError
from fringescope.settings import Settings, describe, from_dict, from_yaml, to_dict, to_yaml

KNOBS = [(section, f) for section, f, _ in describe()]
IDS = [f"{section}.{f.name}" for section, f in KNOBS]


def allowed_values(f: dataclasses.Field[Any]) -> st.SearchStrategy[Any]:
    low, high = f.metadata["low"], f.metadata["high"]
    if isinstance(f.default, bool):
        return st.booleans()
    if isinstance(f.default, int):
        return st.integers(math.ceil(low) if low is not None else -1000, math.floor(high) if high is not None else 1000)
    if isinstance(f.default, float):
        return st.floats(low if low is not None else -1e6, high if high is not None else 1e6, allow_nan=False)
    return st.just(f.default)


@st.composite
def trees(draw: st.DrawFn) -> Settings:
    changed: dict[str, dict[str, Any]] = {}
    for section, f in KNOBS:
        if draw(st.booleans()):
            changed.setdefault(section, {})[f.name] = draw(allowed_values(f))
    return from_dict(changed)


@given(trees())
def test_yaml_and_dict_round_trip(tree: Settings) -> None:
    assert from_yaml(to_yaml(tree)) == tree
    assert from_dict(to_dict(tree)) == tree
    assert yaml.safe_load(to_yaml(tree)) == to_dict(tree)


@pytest.mark.parametrize(("section", "f"), KNOBS, ids=IDS)
def test_every_knob_says_what_it_means(section: str, f: dataclasses.Field[Any]) -> None:
    meta = f.metadata
    assert set(meta) == {"unit", "doc", "paper", "low", "high"}
    assert len(meta["doc"].split()) >= 4
    assert "\n" not in meta["doc"]
    if isinstance(f.default, (int, float)) and not isinstance(f.default, bool):
        assert meta["low"] is None or meta["low"] <= f.default
        assert meta["high"] is None or f.default <= meta["high"]
    block = to_yaml(Settings()).split(f"{section}:\n")[1]
    line = next(row for row in block.splitlines() if row.startswith(f"  {f.name}:"))
    assert meta["doc"] in line
    assert meta["unit"] in line


@pytest.mark.parametrize(("section", "f"), KNOBS, ids=IDS)
def test_wrong_values_are_refused_by_name(section: str, f: dataclasses.Field[Any]) -> None:
    bad: list[Any] = [None, [1]]
    bad += ["much"] if not isinstance(f.default, str) else [3]
    bad += [1] if isinstance(f.default, bool) else [True]
    if isinstance(f.default, float):
        bad.append(math.nan)
    if f.metadata["low"] is not None:
        bad.append(f.metadata["low"] - 1)
    if f.metadata["high"] is not None:
        bad.append(f.metadata["high"] + 1)
    for value in bad:
        with pytest.raises(UsageError, match=f.name) as caught:
            from_dict({section: {f.name: value}})
        assert "\n" not in str(caught.value)


def test_whole_numbers_stay_whole() -> None:
    for section, f in KNOBS:
        if isinstance(f.default, int) and not isinstance(f.default, bool):
            with pytest.raises(UsageError, match=f.name):
                from_dict({section: {f.name: f.default + 0.5}})


def test_frozen_all_the_way_down() -> None:
    tree = Settings()
    with pytest.raises(dataclasses.FrozenInstanceError):
        tree.phase = fs.PhaseSettings()  # type: ignore[misc]
    for section, f in KNOBS:
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(getattr(tree, section), f.name, f.default)


def test_what_is_not_named_keeps_the_base() -> None:
    base = from_dict({"phase": {"order_votes": 7}, "denoise": {"min_background": 9.0}})
    tree = from_yaml("denoise: {min_background: 4}", base)
    assert tree.phase.order_votes == 7
    assert tree.denoise.min_background == 4
    assert from_yaml("", base) == base


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("fase: {order_votes: 3}", "fase"),
        ("phase: {order_vote: 3}", "order_vote"),
        ("phase: 3", "phase"),
        ("[1, 2]", "sections"),
        ("phase: {order_votes: [", "YAML"),
        ("just words", "sections"),
    ],
)
def test_a_bad_file_is_one_clear_line(text: str, said: str) -> None:
    with pytest.raises(UsageError, match=said) as caught:
        from_yaml(text)
    assert "\n" not in str(caught.value)
