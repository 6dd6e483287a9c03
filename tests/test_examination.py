"""The guidance state machine: its way by examples, and any order of events against a slow model of what may be lit."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from fringescope import examination
from fringescope.errors import FormatError
from fringescope.settings import ExaminationSettings
from fringescope.types import examination as t
from fringescope.types.examination import Phase, Role, Standing

S = ExaminationSettings(verdict_s=5.0, suspect_s=10.0, arm_s=60.0, max_strokes=6)
SECOND = 1_000_000_000
ROLE = {"ann": Role.EXPERT, "ben": Role.EXPERT, "olga": Role.OPERATOR, "otto": Role.OBSERVER, "box": Role.INSTRUMENT}
STROKES = (("s1", "line"), ("s2", "circle"))


@dataclass
class Room:
    """An examination with people and a projector that does what effects say."""

    state: t.Examination = field(default_factory=t.Examination)
    now: int = 0
    numbers: dict[str, int] = field(default_factory=dict)
    log: list[t.Event] = field(default_factory=list)
    accepted: list[t.Event] = field(default_factory=list)
    lit: tuple[int, str] | None = None
    last: t.Outcome | None = None

    def event(self, who: str, what: t.What, role: Role | None = None) -> t.Event:
        self.numbers[who] = self.numbers.get(who, 0) + 1
        return t.Event(self.now, who, role or ROLE[who], f"{who}'s browser", self.numbers[who], what)

    def deliver(self, event: t.Event) -> t.Outcome:
        self.log.append(event)
        self.last = out = examination.apply(self.state, event, S)
        self.state = out.state
        for e in out.effects:
            if isinstance(e, t.Show):
                self.lit = (e.version, e.pattern)
            elif isinstance(e, t.Dark):
                assert e.why
                self.lit = None
        if out.refused:
            assert out.effects == ()
            assert "\n" not in out.refused
            assert len(out.refused) < 1000
        else:
            self.accepted.append(event)
        return out

    def say(self, who: str, what: t.What, role: Role | None = None) -> t.Outcome:
        return self.deliver(self.event(who, what, role))

    def ok(self, who: str, what: t.What) -> t.Outcome:
        out = self.say(who, what)
        assert out.refused == ""
        return out

    def no(self, who: str, what: t.What, match: str, role: Role | None = None) -> None:
        before = self.state, self.lit
        out = self.say(who, what, role)
        assert match in out.refused
        assert replace(out.state, clients=()) == replace(before[0], clients=())
        assert self.lit == before[1]

    def version(self, number: int) -> t.Version:
        return self.state.versions[number - 1]

    def phase(self, number: int = 1) -> Phase:
        return self.version(number).phase

    # the usual way, as far as it is wanted

    def begin(self) -> Room:
        self.ok("box", t.ScanTaken("scan1", "rig1"))
        self.ok("box", t.Guarded())
        self.ok("box", t.Watched("scan1", Standing.VALID))
        return self

    def draw(self, who: str = "ann", strokes: tuple[tuple[str, str], ...] = STROKES) -> Room:
        for stroke, content in strokes:
            self.ok(who, t.Put(stroke, content, self.state.scan))
        return self

    def submit(self, who: str = "ann", strokes: tuple[tuple[str, str], ...] = STROKES) -> int:
        out = self.ok(who, t.Submit(strokes, self.state.scan, self.state.rig))
        number = len(self.state.versions)
        assert t.Check(number) in out.effects
        return number

    def check(self, n: int = 1) -> Room:
        out = self.ok("box", t.Checked(n, self.version(n).content, f"picture{n}", f"dashes{n}"))
        assert out.effects == (t.Preview(n, f"picture{n}"),)
        return self

    def preview(self, n: int = 1) -> Room:
        self.ok("box", t.Previewed(n, self.version(n).pattern))
        return self

    def arm(self, n: int = 1) -> Room:
        self.ok("olga", t.Arm(n, self.version(n).content, self.version(n).pattern))
        return self

    def start(self, n: int = 1) -> Room:
        self.ok("olga", t.Start(n, self.version(n).pattern))
        return self

    def to_light(self, who: str = "ann", strokes: tuple[tuple[str, str], ...] = STROKES) -> Room:
        n = self.draw(who, strokes).submit(who, strokes)
        return self.check(n).preview(n).arm(n).start(n)


def room() -> Room:
    return Room().begin()


# ------------------------------------------------------------------------------------------------------------- the way


def test_the_usual_way_ends_in_the_light_and_stop_ends_that() -> None:
    r = room()
    r.draw()
    phases = []
    for step in (r.submit, r.check, r.preview, r.arm, r.start):
        assert r.lit is None
        step()
        phases.append(r.phase())
    assert phases == [Phase.SUBMITTED, Phase.CHECKED, Phase.PREVIEWED, Phase.ARMED, Phase.PROJECTING]
    assert r.lit == (1, "picture1")
    assert r.ok("otto", t.Stop(why="a hand")).effects == (t.Dark("stopped by otto: a hand"),)
    assert r.lit is None
    assert r.phase() is Phase.STOPPED


def test_what_was_stopped_comes_back_by_way_of_preview_and_arming_only() -> None:
    r = room().to_light()
    r.ok("ann", t.Stop())
    v = r.version(1)
    r.no("olga", t.Start(1, v.pattern), "stopped")
    r.no("olga", t.Arm(1, v.content, v.pattern), "stopped")
    r.preview().arm().start()
    assert r.lit == (1, "picture1")


@pytest.mark.parametrize("who", ["ann", "otto", "box"])
def test_only_the_operator_confirms_arms_and_starts(who: str) -> None:
    r = room().draw()
    r.submit()
    r.check().preview()
    v = r.version(1)
    r.no(who, t.Arm(1, v.content, v.pattern), "not for the")
    r.arm()
    r.no(who, t.Start(1, v.pattern), "not for the")
    r.start()
    r.ok("box", t.Watched("scan1", Standing.SUSPECT))
    r.no(who, t.Acknowledge(r.state.suspect_ns), "not for the")


@pytest.mark.parametrize("who", ["ann", "olga", "otto"])
def test_people_do_not_speak_for_the_instrument(who: str) -> None:
    r = room().draw()
    r.submit()
    for what in (
        t.ScanTaken("s", "r"), t.RigChanged("r"), t.Checked(1, r.version(1).content, "p", "d"), t.Previewed(1, "p"),
        t.Watched("scan1", Standing.VALID), t.Guarded(), t.GuardLost("x"), t.DeviceLost("x"), t.DeviceBack("x"),
        t.Expired(t.Term.ARM),
    ):  # fmt: skip
        r.no(who, what, "not for the")


@pytest.mark.parametrize("who", list(ROLE))
@pytest.mark.parametrize("steps", range(6))
def test_anybody_stops_from_everywhere(who: str, steps: int) -> None:
    r = room()
    r.draw()
    for step in (r.submit, r.check, r.preview, r.arm, r.start)[:steps]:
        step()
    out = r.ok(who, t.Stop(1 if steps % 2 else None))
    assert r.lit is None
    assert any(isinstance(e, t.Dark) for e in out.effects)  # even where nothing was lit: to be sure
    if steps >= 4 or (steps and steps % 2):
        assert r.phase() is Phase.STOPPED


def test_a_stop_of_an_unknown_version_is_a_stop_of_all_and_of_another_one_of_none() -> None:
    r = room().to_light()
    n = r.draw("ben", (("b1", "x"),)).submit("ben", (("b1", "x"),))
    r.ok("ann", t.Stop(n))
    assert (r.phase(n), r.lit) == (Phase.STOPPED, (1, "picture1"))
    r.ok("ann", t.Stop(99, "line\nbreak"))
    assert r.lit is None


# ------------------------------------------------------------------------------------------------ what belongs together


def test_only_the_picture_that_was_checked_previewed_and_confirmed() -> None:
    r = room().draw()
    r.submit()
    content = r.version(1).content
    r.no("box", t.Previewed(1, "picture1"), "submitted")
    r.no("box", t.Checked(1, "another", "picture1", "dashes1"), "content another")
    r.no("box", t.Checked(1, content, "picture1", ""), "dashed")
    r.check()
    r.no("box", t.Checked(1, content, "picture9", "dashes9"), "only what is submitted")
    r.no("olga", t.Arm(1, content, "picture1"), "only what was previewed")
    r.no("box", t.Previewed(1, "picture2"), "picture picture2")
    r.preview()
    r.no("olga", t.Arm(1, "another", "picture1"), "content another was confirmed")
    r.no("olga", t.Arm(1, content, "dashes1"), "picture dashes1")
    r.no("olga", t.Arm(2, content, "picture1"), "no version 2")
    r.no("olga", t.Start(1, "picture1"), "only what is armed")
    r.arm()
    r.no("olga", t.Start(1, "dashes1"), "picture dashes1")
    r.start()
    assert r.lit == (1, "picture1")


def test_the_content_binds_strokes_scan_and_rig() -> None:
    one = examination.content_of((("a", "b"), ("c", "d")), "scan", "rig")
    others = [
        examination.content_of(s, scan, rig)
        for s, scan, rig in (
            ((("a", "b"),), "scan", "rig"),
            ((("c", "d"), ("a", "b")), "scan", "rig"),
            ((("a", "bc"), ("", "d")), "scan", "rig"),
            ((("a", "b"), ("c", "d")), "scan2", "rig"),
            ((("a", "b"), ("c", "d")), "scan", "rig2"),
        )
    ]
    assert len({one, *others}) == 6
    assert len(one) == 64


def test_strokes_that_are_not_ones_own_or_not_there_are_refused() -> None:
    r = room().draw()
    r.no("ben", t.Put("s1", "mine now", "scan1"), "ann's")
    r.no("ben", t.Remove("s1"), "ann's")
    r.no("ann", t.Remove("s9"), "no stroke s9")
    r.no("otto", t.Put("o1", "x", "scan1"), "not for the observer")
    r.no("ann", t.Put("s3", "x", "scan0"), "the present one is scan1")
    r.no("ann", t.Put("", "x", "scan1"), "printable")
    r.no("ann", t.Put("s3", "x\ny", "scan1"), "printable")
    r.no("ann", t.Put("s" * 1000, "x", "scan1"), "printable")
    for strokes, why in (
        ((), "without strokes"),
        ((("s9", "x"),), "no stroke s9"),
        ((("s1", "line"), ("s1", "line")), "twice"),
        ((("s1", "circle"),), "was changed"),
    ):
        r.no("ann", t.Submit(strokes, "scan1", "rig1"), why)
    r.no("ben", t.Submit((("s1", "line"),), "scan1", "rig1"), "no stroke s1 by ben")
    r.no("ann", t.Submit(STROKES, "scan0", "rig1"), "draw it on that scan")
    r.no("ann", t.Submit(STROKES, "scan1", "rig0"), "draw it on that scan")
    for k in range(3, 7):
        r.ok("ann", t.Put(f"s{k}", "x", "scan1"))
    r.no("ann", t.Put("s7", "x", "scan1"), "more than 6")
    r.ok("ann", t.Remove("s6"))
    r.ok("ann", t.Put("s7", "x", "scan1"))
    r.ok("ben", t.Put("b1", "x", "scan1"))  # another's draft is another's


def test_nothing_begins_without_a_scan() -> None:
    r = Room()
    r.no("ann", t.Put("s1", "line", ""), "printable")
    r.no("ann", t.Put("s1", "line", "scan1"), "none")
    r.no("ann", t.Submit(STROKES, "scan1", "rig1"), "none")
    r.no("box", t.Watched("scan1", Standing.VALID), "none")
    assert examination.shown(r.state) is None


def test_a_check_that_finds_nothing_to_show_sends_it_back() -> None:
    r = room().draw()
    r.submit()
    r.ok("box", t.Checked(1, r.version(1).content, "", "", ("stroke s1: off the specimen",)))
    assert r.phase() is Phase.DRAFT
    assert "off the specimen" in r.version(1).why
    r.no("box", t.Previewed(1, ""), "printable")
    r.no("box", t.Previewed(1, "x"), "draft")
    r.ok("ann", t.Put("s1", "on it", "scan1"))
    n = r.submit(strokes=(("s1", "on it"),))
    assert r.phase(1) is Phase.SUPERSEDED
    r.check(n).preview(n).arm(n).start(n)


# ------------------------------------------------------------------------------------------------------ newer versions


@pytest.mark.parametrize("steps", range(5))
def test_a_new_submission_supersedes_what_is_not_in_the_light(steps: int) -> None:
    r = room()
    r.draw()
    for step in (r.submit, r.check, r.preview, r.arm)[: max(steps, 1)]:
        step()
    r.ok("ann", t.Put("s1", "longer", "scan1"))
    n = r.submit(strokes=(("s1", "longer"),))
    assert r.phase(1) is Phase.SUPERSEDED
    v = r.version(1)
    r.no("olga", t.Start(1, v.pattern or "x"), "superseded")
    r.check(n).preview(n).arm(n).start(n)
    assert r.lit == (2, "picture2")


def test_what_is_in_the_light_stays_until_the_operator_starts_the_newer() -> None:
    r = room().to_light()
    r.ok("ann", t.Put("s1", "longer", "scan1"))
    out = r.ok("ann", t.Submit((("s1", "longer"),), "scan1", "rig1"))
    assert any(isinstance(e, t.Warn) and "version 2 by ann waits" in e.text for e in out.effects)
    for step in (r.check, r.preview, r.arm):
        assert r.lit == (1, "picture1")
        step(2)
    assert r.lit == (1, "picture1")
    r.start(2)
    assert r.lit == (2, "picture2")
    assert (r.phase(1), r.phase(2)) == (Phase.SUPERSEDED, Phase.PROJECTING)


def test_experts_do_not_supersede_each_other() -> None:
    r = room()
    r.draw()
    r.submit()
    r.check().preview().arm()
    n = r.draw("ben", (("b1", "x"),)).submit("ben", (("b1", "x"),))
    assert r.phase(1) is Phase.ARMED
    r.check(n).preview(n).arm(n)  # one at a time is armed
    assert r.phase(1) is Phase.PREVIEWED
    r.start(n).arm(1).start(1)
    assert (r.phase(1), r.phase(n)) == (Phase.PROJECTING, Phase.STOPPED)
    assert r.lit == (1, "picture1")


def test_the_same_again_is_no_new_version() -> None:
    r = room().draw()
    r.submit()
    r.no("ann", t.Submit(STROKES, "scan1", "rig1"), "version 1 is the same")
    r.ok("ann", t.Stop(1))
    assert r.submit() == 2
    assert r.phase(1) is Phase.SUPERSEDED


# --------------------------------------------------------------------------------------------------------------- doubt

DOUBT: dict[str, tuple[t.What, Phase]] = {
    "another scan": (t.ScanTaken("scan2", "rig1"), Phase.STALE),
    "the same scan by another rig": (t.ScanTaken("scan1", "rig2"), Phase.STALE),
    "another rig": (t.RigChanged("rig2"), Phase.STALE),
    "moved": (t.Watched("scan1", Standing.STALE), Phase.STALE),
    "no heartbeat": (t.GuardLost("no heartbeat for 60 ms"), Phase.STOPPED),
    "a device": (t.DeviceLost("camera2"), Phase.STOPPED),
}


@pytest.mark.parametrize("name", DOUBT)
@pytest.mark.parametrize("armed", [False, True])
def test_doubt_makes_dark_and_bars_the_way_back(name: str, armed: bool) -> None:
    what, phase = DOUBT[name]
    r = room().draw()
    r.submit()
    r.check().preview().arm()
    if not armed:
        r.start()
    out = r.ok("box", what)
    assert r.lit is None
    assert armed or any(isinstance(e, t.Dark) for e in out.effects)
    assert r.phase() is phase
    assert r.version(1).why
    v = r.version(1)
    r.no("olga", t.Start(1, v.pattern), v.phase.value)
    if phase is Phase.STOPPED:
        r.preview()
        r.no("olga", t.Arm(1, v.content, v.pattern), "watchdog" if name == "no heartbeat" else "camera2")
        r.ok("box", t.Guarded() if name == "no heartbeat" else t.DeviceBack("camera2"))
        assert r.lit is None  # nothing comes back by itself
        r.arm().start()
        assert r.lit == (1, "picture1")
    else:
        r.no("box", t.Previewed(1, v.pattern), "stale")


def test_after_a_stale_verdict_only_a_new_scan_helps() -> None:
    r = room().to_light()
    r.ok("box", t.Watched("scan1", Standing.STALE, "moved by 0.3 mm"))
    assert "moved by 0.3 mm" in r.version(1).why
    r.no("box", t.Watched("scan1", Standing.VALID), "stale for good")
    r.no("ann", t.Submit(STROKES, "scan1", "rig1"), "scan again")
    r.ok("box", t.ScanTaken("scan2", "rig1"))
    r.no("ann", t.Submit(STROKES, "scan2", "rig1"), "drawn on scan scan1")
    r.no("ann", t.CarryOver(1, (("c1", "line moved"),), "scan2", 20.0), "not for the expert")
    r.no("olga", t.CarryOver(1, (("c1", "line moved"),), "scan2", float("nan")), "residual")
    r.no("olga", t.CarryOver(1, (), "scan2", 20.0), "nothing")
    r.no("olga", t.CarryOver(1, (("s1", "line moved"),), "scan2", 20.0), "ann's")
    r.ok("olga", t.CarryOver(1, (("c1", "line moved"),), "scan2", 20.0))
    n = r.submit("olga", (("c1", "line moved"),))
    r.check(n).preview(n)
    r.no("olga", t.Arm(n, r.version(n).content, f"picture{n}"), "was not looked at")
    r.ok("box", t.Watched("scan2", Standing.VALID))
    r.arm(n).start(n)
    r.no("olga", t.CarryOver(n, (("c2", "x"),), "scan2", 1.0), "only what is stale")


def test_a_suspect_specimen_gets_dashed_lines_and_the_operator_is_asked() -> None:
    r = room().to_light()
    out = r.ok("box", t.Watched("scan1", Standing.SUSPECT, "0.2 mm"))
    assert r.lit == (1, "dashes1")
    assert any(isinstance(e, t.Warn) for e in out.effects)
    since = r.state.suspect_ns
    assert r.ok("box", t.Watched("scan1", Standing.SUSPECT)).effects == ()  # said once
    r.no("olga", t.Acknowledge(since + 1), "no such warning")
    r.ok("olga", t.Acknowledge(since))
    r.now += int(11 * SECOND)
    r.ok("box", t.Watched("scan1", Standing.SUSPECT))
    assert examination.due(r.state, r.now, S) == ()
    assert r.lit == (1, "dashes1")
    r.ok("box", t.Watched("scan1", Standing.VALID))
    assert r.lit == (1, "picture1")
    r.now += 1
    r.ok("box", t.Watched("scan1", Standing.SUSPECT))
    r.no("olga", t.Acknowledge(since), "no such warning")  # an old yes is no yes to this
    assert not r.state.acknowledged


def test_a_suspect_specimen_starts_nothing_unasked() -> None:
    r = room().draw()
    r.submit()
    r.check().preview().arm()
    r.ok("box", t.Watched("scan1", Standing.SUSPECT))
    r.no("olga", t.Start(1, "picture1"), "may have moved")
    r.ok("olga", t.Acknowledge(r.state.suspect_ns))
    r.start()
    assert r.lit == (1, "dashes1")


# ---------------------------------------------------------------------------------------------------------------- time


def expire(r: Room, term: t.Term) -> None:
    assert t.Expired(term) in examination.due(r.state, r.now, S)
    for what in examination.due(r.state, r.now, S):
        r.say("box", what)


def test_a_verdict_grows_old() -> None:
    r = room().to_light()
    r.now += int(4.9 * SECOND)
    assert examination.due(r.state, r.now, S) == ()
    r.no("box", t.Expired(t.Term.VERDICT), "not over")
    r.now += int(0.2 * SECOND)
    expire(r, t.Term.VERDICT)
    assert (r.lit, r.phase()) == (None, Phase.STOPPED)
    r.preview()
    r.no("olga", t.Arm(1, r.version(1).content, "picture1"), "look again")


def test_no_answer_to_a_warning_is_no() -> None:
    r = room().to_light()
    r.ok("box", t.Watched("scan1", Standing.SUSPECT))
    for _ in range(4):
        r.now += int(2.6 * SECOND)
        r.ok("box", t.Watched("scan1", Standing.SUSPECT))
    expire(r, t.Term.ACKNOWLEDGEMENT)
    assert (r.lit, r.phase()) == (None, Phase.STOPPED)


def test_armed_for_too_long_must_be_armed_again() -> None:
    r = room().draw()
    r.submit()
    r.check().preview().arm()
    r.now += int(60.5 * SECOND)
    r.ok("box", t.Watched("scan1", Standing.VALID))
    r.no("olga", t.Start(1, "picture1"), "arm it again")
    expire(r, t.Term.ARM)
    assert r.phase() is Phase.PREVIEWED
    r.arm().start()


def test_a_late_heartbeat_is_a_lost_one() -> None:
    r = room().to_light()
    assert examination.due(r.state, r.now, S, r.now - 40_000_000, 50.0) == ()
    (lost,) = examination.due(r.state, r.now, S, r.now - 60_000_000, 50.0)
    assert lost == t.GuardLost("no heartbeat for 60 ms")
    r.ok("box", lost)
    assert r.lit is None
    assert examination.due(r.state, r.now, S, r.now - 60_000_000, 50.0) == ()  # said once


# ---------------------------------------------------------------------------------------------- twice, late, malformed


def test_the_same_word_twice_does_nothing() -> None:
    r = room().to_light()
    for event in list(r.log):
        if not isinstance(event.what, t.Stop):
            before = r.state
            out = r.deliver(event)
            assert "before" in out.refused
            assert out.state == before
    assert r.lit == (1, "picture1")


def test_a_refused_start_does_not_come_true_later() -> None:
    r = room().draw()
    r.submit()
    r.check().preview()
    early = r.event("olga", t.Start(1, "picture1"))
    assert "previewed" in r.deliver(early).refused
    r.arm()
    assert "before" in r.deliver(early).refused
    assert r.lit is None


def test_a_late_stop_is_obeyed_and_a_repeated_one_is_not() -> None:
    r = room().to_light()
    late = r.event("ann", t.Stop())
    r.ok("ann", t.Put("s3", "x", "scan1"))
    assert r.lit
    assert r.deliver(late).refused == ""
    assert r.lit is None
    r.preview().arm().start()
    assert "before" in r.deliver(late).refused
    assert r.lit


def test_events_without_sender_or_number_are_refused() -> None:
    r = room()
    for change in ({"number": 0}, {"number": -1}, {"number": True}, {"who": ""}, {"client": ""}, {"at_ns": 0.5}):
        event: Any = replace(r.event("olga", t.Stop()), **change)
        out = examination.apply(r.state, event, S)
        assert "send it again" in out.refused
        assert out.state == r.state


def test_everything_goes_through_json_and_back() -> None:
    r = room().to_light()
    r.ok("box", t.Watched("scan1", Standing.SUSPECT))
    r.ok("ann", t.Stop(why="a hand"))
    for value in (*r.log, r.state, r.last, *(e for e in r.last.effects)):
        assert examination.from_dict(json.loads(json.dumps(examination.to_dict(value)))) == value
    assert examination.replay(r.log, S) == r.state
    newer = {**examination.to_dict(r.state), "colour": "blue"}
    assert examination.from_dict(newer) == r.state  # a key of a later version


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"kind": "Explode"}, "needed one of"),
        ({"kind": None}, "needed one of"),
        ({"kind": ["Stop"]}, "needed one of"),
        ({"number": "1"}, "Event.number"),
        ({"number": True}, "Event.number"),
        ({"role": "king"}, "needed expert, operator"),
        ({"what": {"kind": "Dark", "why": "x"}}, "does not belong"),
        ({"what": "Stop"}, "needed one of"),
        ({"what": {"kind": "Submit", "strokes": [["a"]], "scan": "s", "rig": "r"}}, "list of 2"),
        ({"what": {"kind": "Submit", "strokes": "ab", "scan": "s", "rig": "r"}}, "needed a list"),
        (
            {"what": {"kind": "CarryOver", "version": 1, "strokes": [], "scan": "s", "residual_um": float("nan")}},
            "float",
        ),
        ({"what": {"kind": "Submit", "strokes": []}}, "without 'scan'"),
    ],
)
def test_dictionaries_that_mean_nothing_are_refused(change: dict[str, Any], match: str) -> None:
    good = examination.to_dict(t.Event(1, "ann", Role.EXPERT, "c", 1, t.Stop()))
    with pytest.raises(FormatError, match=match):
        examination.from_dict({**good, **change})


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
        lambda x: (
            st.lists(x)
            | st.dictionaries(
                st.sampled_from(["kind", "at_ns", "who", "role", "client", "number", "what", "version"]), x
            )
        ),
    )
)
@settings(max_examples=40)
def test_any_json_is_an_event_or_a_format_error(value: object) -> None:
    with contextlib.suppress(FormatError):
        examination.from_dict(value)


# ------------------------------------------------------------------------------ any order, against a slow obvious model


def lit_by_the_log(log: list[t.Event]) -> tuple[int, str] | None:
    """What may be lit after these accepted events, found by reading the log backwards and forwards; no states."""

    def before(i: int, wanted: Callable[[t.What], bool]) -> int | None:
        return next((k for k in range(i - 1, -1, -1) if wanted(log[k].what)), None)

    def is_a(kind: type, **values: object) -> Callable[[t.What], bool]:
        return lambda w: isinstance(w, kind) and all(getattr(w, n) == v for n, v in values.items())

    end = len(log)
    i = before(end, is_a(t.Start))
    if i is None:
        return None
    assert log[i].role is Role.OPERATOR
    start: Any = log[i].what
    n = start.version

    def ends(k: int) -> bool:
        w = log[k].what
        submitted = sum(isinstance(e.what, t.Submit) for e in log[:k])
        return (
            isinstance(w, (t.GuardLost, t.DeviceLost, t.ScanTaken, t.RigChanged))
            or (isinstance(w, t.Stop) and (w.version in (None, n) or not 1 <= w.version <= submitted))
            or (isinstance(w, t.Watched) and w.validity is Standing.STALE)
            or (isinstance(w, t.Expired) and w.term is not t.Term.ARM)
        )

    if any(ends(k) for k in range(i + 1, end)):
        return None
    # the way to the light, each word after the one before and nothing that ends it in between
    arm = before(i, is_a(t.Arm, version=n))
    assert arm is not None
    assert not any(ends(k) for k in range(arm, i))
    assert not any(isinstance(e.what, t.Arm) for e in log[arm + 1 : i])
    assert log[arm].role is Role.OPERATOR
    seen = before(arm, is_a(t.Previewed, version=n))
    assert seen is not None
    checked = before(seen, is_a(t.Checked, version=n))
    assert checked is not None
    submits = [k for k, e in enumerate(log) if isinstance(e.what, t.Submit)]
    asked = submits[n - 1]
    assert asked < checked
    submit, check, arming, preview = (log[k].what for k in (asked, checked, arm, seen))
    content = examination.content_of(submit.strokes, submit.scan, submit.rig)
    assert check.content == arming.content == content
    assert check.pattern == preview.pattern == arming.pattern == start.pattern
    # strokes as their author drew them, on the scan that is the present one all the way
    for stroke, what in submit.strokes:
        k = before(
            asked,
            lambda w, s=stroke: (
                (isinstance(w, (t.Put, t.Remove)) and w.stroke == s)
                or (isinstance(w, t.CarryOver) and s in dict(w.strokes))
            ),
        )
        assert k is not None
        assert log[k].who == log[asked].who
        assert not isinstance(log[k].what, t.Remove)
        drawn = log[k].what
        assert (drawn.content if isinstance(drawn, t.Put) else dict(drawn.strokes)[stroke]) == what
        assert drawn.scan == submit.scan
    k = before(i, is_a(t.ScanTaken))
    assert k is not None
    assert k < asked
    assert (log[k].what.scan, log[k].what.rig) == (submit.scan, submit.rig)
    assert before(i, is_a(t.RigChanged)) is None or before(i, is_a(t.RigChanged)) < k
    # nothing newer of the same author, watchdog and devices there
    newer = [m for m in submits[n:] if m < i and log[m].who == log[asked].who]
    was_lit = before(asked + 1, is_a(t.Start, version=n)) is not None
    assert (
        not newer or was_lit or any(isinstance(e.what, t.Start) and e.what.version == n for e in log[asked : newer[0]])
    )
    g = before(i, lambda w: isinstance(w, (t.Guarded, t.GuardLost)))
    assert g is not None
    assert isinstance(log[g].what, t.Guarded)
    for name in {e.what.device for e in log[:i] if isinstance(e.what, t.DeviceLost)}:
        d = before(i, lambda w, name=name: isinstance(w, (t.DeviceLost, t.DeviceBack)) and w.device == name)
        assert isinstance(log[d].what, t.DeviceBack)
    # somebody had just looked; where it was suspect, the operator had said go on since
    w = before(i, is_a(t.Watched))
    assert w is not None
    assert w > k
    assert (log[i].at_ns - log[w].at_ns) <= S.verdict_s * SECOND
    if log[w].what.validity is Standing.SUSPECT:
        first = w
        while (p := before(first, is_a(t.Watched))) is not None and p > k and log[p].what.validity is Standing.SUSPECT:
            first = p
        assert any(isinstance(e.what, t.Acknowledge) and e.role is Role.OPERATOR for e in log[first:i])
    last: Any = log[before(end, is_a(t.Watched))].what
    return n, check.dashed if last.validity is Standing.SUSPECT else check.pattern


EDGES = {
    Phase.SUBMITTED: {Phase.CHECKED, Phase.DRAFT, Phase.STOPPED},
    Phase.CHECKED: {Phase.PREVIEWED, Phase.STOPPED},
    Phase.PREVIEWED: {Phase.ARMED, Phase.STOPPED},
    Phase.ARMED: {Phase.PROJECTING, Phase.PREVIEWED, Phase.STOPPED},
    Phase.PROJECTING: {Phase.STOPPED},
    Phase.STOPPED: {Phase.PREVIEWED},
    Phase.DRAFT: {Phase.STOPPED},
    Phase.STALE: set(),
    Phase.SUPERSEDED: set(),
}

PEOPLE = st.sampled_from(list(ROLE))
WORDS = st.sampled_from(
    ["scan1", "scan2", "rig1", "rig2", "picture1", "dashes1", "s1", "s2", "b1", "line", "circle", "", "x\ny"]
)
NUMBERS = st.integers(1, 4)
PAIRS = st.lists(st.tuples(st.sampled_from(["s1", "s2", "b1"]), st.sampled_from(["line", "circle"])), max_size=3).map(
    tuple
)
ANY_WHAT = st.one_of(
    st.builds(t.ScanTaken, st.sampled_from(["scan1", "scan2"]), st.sampled_from(["rig1", "rig2"])),
    st.builds(t.RigChanged, st.sampled_from(["rig1", "rig2"])),
    st.builds(t.Put, st.sampled_from(["s1", "s2", "b1"]), st.sampled_from(["line", "circle"]), WORDS),
    st.builds(t.Remove, WORDS),
    st.builds(t.CarryOver, NUMBERS, PAIRS, WORDS, st.floats(-1, 100)),
    st.builds(t.Submit, PAIRS, WORDS, WORDS),
    st.builds(t.Checked, NUMBERS, WORDS, WORDS, WORDS),
    st.builds(t.Previewed, NUMBERS, WORDS),
    st.builds(t.Arm, NUMBERS, WORDS, WORDS),
    st.builds(t.Start, NUMBERS, WORDS),
    st.builds(t.Acknowledge, st.integers(0, 10**10)),
    st.builds(t.Stop, st.none() | NUMBERS, WORDS),
    st.builds(t.Watched, WORDS, st.sampled_from(Standing)),
    st.just(t.Guarded()),
    st.builds(t.GuardLost, WORDS),
    st.builds(t.DeviceLost, st.sampled_from(["camera1", "projector"])),
    st.builds(t.DeviceBack, st.sampled_from(["camera1", "projector"])),
    st.builds(t.Expired, st.sampled_from(t.Term)),
)  # fmt: skip


class AnyOrder(RuleBasedStateMachine):
    """People who do the sensible next thing, people who do anything, a network that repeats and delays, and a clock."""

    def __init__(self) -> None:
        super().__init__()
        self.room = Room()
        self.kept: list[t.Event] = []  #: on their way, or sent again

    def send(self, event: t.Event) -> None:
        before = self.room.state
        self.room.deliver(event)
        old = {v.number: v for v in before.versions}
        for v in self.room.state.versions:
            if v.number in old:
                was = old[v.number]
                fixed = ("author", "strokes", "scan", "rig", "content")
                assert all(getattr(v, f) == getattr(was, f) for f in fixed)
                assert was.pattern in ("", v.pattern)
                late = {Phase.STALE, Phase.SUPERSEDED} if was.phase not in (Phase.STALE, Phase.SUPERSEDED) else set()
                assert v.phase is was.phase or v.phase in EDGES[was.phase] | late

    @initialize(ready=st.integers(0, 4))
    def begin(self, ready: int) -> None:
        if ready:
            self.room.begin()

    @rule(who=st.sampled_from(["ann", "ben", "olga"]), content=st.sampled_from(["line", "circle", "arrow"]))
    @precondition(lambda self: self.room.state.scan)
    def draw_and_submit(self, who: str, content: str) -> None:
        stroke = {"ann": "s1", "ben": "b1", "olga": "c1"}[who]
        self.send(self.room.event(who, t.Put(stroke, content, self.room.state.scan)))
        self.send(self.room.event(who, t.Submit(((stroke, content),), self.room.state.scan, self.room.state.rig)))

    def one_step(self, n: int) -> None:
        """What sensible people do next with a version."""
        v = self.room.version(n)
        todo: dict[Phase, tuple[str, t.What]] = {
            Phase.SUBMITTED: ("box", t.Checked(n, v.content, f"picture{n}", f"dashes{n}")),
            Phase.CHECKED: ("box", t.Previewed(n, v.pattern)),
            Phase.STOPPED: ("box", t.Previewed(n, v.pattern)),
            Phase.PREVIEWED: ("olga", t.Arm(n, v.content, v.pattern)),
            Phase.ARMED: ("olga", t.Start(n, v.pattern)),
        }
        if v.phase in todo:
            who, what = todo[v.phase]
            self.send(self.room.event(who, what))

    @rule(pick=st.integers(0, 100), steps=st.integers(1, 5), look=st.booleans())
    @precondition(lambda self: self.room.state.versions)
    def sensible(self, pick: int, steps: int, look: bool) -> None:
        n = self.room.state.versions[-1 - pick % min(3, len(self.room.state.versions))].number
        if look:
            self.ready()
        for _ in range(steps):
            self.one_step(n)

    @rule(who=st.sampled_from(["ann", "ben"]), content=st.sampled_from(["line", "circle", "arrow"]))
    @precondition(lambda self: self.room.state.scan)
    def all_the_way(self, who: str, content: str) -> None:
        self.ready()
        self.draw_and_submit(who, content)
        if self.room.state.versions:
            for _ in range(5):
                self.one_step(len(self.room.state.versions))

    @rule(who=st.sampled_from(["ann", "ben"]))
    @precondition(lambda self: self.room.lit)
    def a_newer_one_while_lit(self, who: str) -> None:
        n = self.room.state.versions[-1].number
        self.draw_and_submit(who, f"content {n}")

    @rule(answer=st.booleans(), seconds=st.sampled_from([0.0, 4.0, 11.0]))
    @precondition(lambda self: self.room.lit)
    def doubt_while_lit(self, answer: bool, seconds: float) -> None:
        self.look(Standing.SUSPECT)
        assert self.room.lit
        assert self.room.lit[1].startswith("dashes")
        if answer:
            self.go_on()
        self.wait(seconds, True)
        assert (self.room.lit is None) == (seconds > S.verdict_s)

    def ready(self) -> None:
        """Everything in order, as far as it can be."""
        for name in self.room.state.lost:
            self.send(self.room.event("box", t.DeviceBack(name)))
        self.send(self.room.event("box", t.Guarded()))
        if self.room.state.validity is Standing.STALE or not self.room.state.scan:
            self.scan_again(len(self.room.log), "rig1")
        self.send(self.room.event("box", t.Watched(self.room.state.scan or "scan1", Standing.VALID)))

    @rule(
        validity=st.sampled_from([Standing.VALID, Standing.SUSPECT, Standing.SUSPECT, Standing.SUSPECT, Standing.STALE])
    )
    @precondition(lambda self: self.room.state.scan)
    def look(self, validity: Standing) -> None:
        self.send(self.room.event("box", t.Watched(self.room.state.scan, validity)))

    @rule()
    @precondition(lambda self: self.room.state.validity is Standing.SUSPECT)
    def go_on(self) -> None:
        self.send(self.room.event("olga", t.Acknowledge(self.room.state.suspect_ns)))

    @rule(scan=st.integers(1, 9), rig=st.sampled_from(["rig1", "rig1", "rig2"]))
    @precondition(lambda self: len(self.room.log) % 3 == 0)
    def scan_again(self, scan: int, rig: str) -> None:
        self.send(self.room.event("box", t.ScanTaken(f"scan{scan}", rig)))
        self.send(self.room.event("box", t.Guarded()))

    @rule(seconds=st.sampled_from([0.01, 1.0, 3.0, 6.0, 61.0]), told=st.booleans())
    def wait(self, seconds: float, told: bool) -> None:
        self.room.now += int(seconds * SECOND)
        if told:
            for what in examination.due(self.room.state, self.room.now, S):
                self.send(self.room.event("box", what))
            assert examination.due(self.room.state, self.room.now, S) == ()

    @rule(who=PEOPLE, what=ANY_WHAT)
    def anything(self, who: str, what: t.What) -> None:
        self.send(self.room.event(who, what))

    @rule(who=PEOPLE, version=st.none() | st.integers(0, 5))
    @precondition(lambda self: len(self.room.log) % 4 == 0)
    def stop(self, who: str, version: int | None) -> None:
        event = self.room.event(who, t.Stop(version))
        self.send(event)
        assert version in range(1, len(self.room.state.versions) + 1) or self.room.lit is None

    @rule(who=PEOPLE, what=ANY_WHAT)
    def on_its_way(self, who: str, what: t.What) -> None:
        self.kept.append(self.room.event(who, what))

    @rule(data=st.data())
    @precondition(lambda self: self.kept)
    def arrives_late(self, data: st.DataObject) -> None:
        self.send(self.kept.pop(data.draw(st.integers(0, len(self.kept) - 1))))

    @rule(data=st.data())
    @precondition(lambda self: self.room.log)
    def once_more(self, data: st.DataObject) -> None:
        """What arrives twice does nothing, but that an old word that makes dark may do so again."""
        event = data.draw(st.sampled_from(self.room.log[-12:]))
        before = replace(self.room.state, clients=()), self.room.lit
        self.send(event)
        assert (replace(self.room.state, clients=()), self.room.lit) == before or self.room.lit is None

    @invariant()
    def the_light_is_what_the_log_allows(self) -> None:
        now = examination.shown(self.room.state)
        assert self.room.lit == (None if now is None else (now.version, now.pattern))
        assert self.room.lit == lit_by_the_log(self.room.accepted)
        assert sum(v.phase is Phase.PROJECTING for v in self.room.state.versions) <= 1
        assert sum(v.phase is Phase.ARMED for v in self.room.state.versions) <= 1

    def teardown(self) -> None:
        assert examination.replay(self.room.log, S) == self.room.state
        log = [examination.from_dict(json.loads(json.dumps(examination.to_dict(e)))) for e in self.room.log]
        assert examination.replay(log, S) == self.room.state
        assert examination.from_dict(json.loads(json.dumps(examination.to_dict(self.room.state)))) == self.room.state


def test_any_order_of_events() -> None:
    run_state_machine_as_test(AnyOrder, settings=settings(max_examples=40, stateful_step_count=40))


@pytest.mark.verify
@pytest.mark.timeout(3600)
def test_any_order_of_many_events() -> None:
    run_state_machine_as_test(AnyOrder, settings=settings(max_examples=1000, stateful_step_count=60))
