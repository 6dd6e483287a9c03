"""A patient who asks for it is forgotten by the hub; the log still verifies."""

from __future__ import annotations

import json
import sqlite3
import threading
import time
import zipfile
from contextlib import closing
from pathlib import Path

import pytest

from fringescope.client import Client, HubCase, HubError
from fringescope.server.running import Server
from tests.server.conftest import PASSWORD, SignIn
from tests.server.test_audit import by_hand, judged
from tests.server.test_backup import with_file
from tests.server.test_hub import invite, scanned, stroke

SECRETS = (
    "Ada Unlikely-Name",
    "PID-556677",
    "S26-SECRET-1",
    "a mole like a heart",
    "pink stitches",
    "Guest Holm-Quist",
)


@pytest.fixture
def told(hub: Server, sign_in: SignIn) -> HubCase:
    """A case in which people have written what points to a patient."""
    operator, expert = sign_in("operator"), sign_in("expert")
    patient = {"name": SECRETS[0], "identifier": SECRETS[1], "born": ""}
    from fringescope.types.examination import RigChanged, ScanTaken
    from tests.server.test_hub import RIG, SCAN
    from tests.server.test_hub import told as word

    case = operator.open_case(SECRETS[2], {"notes": SECRETS[3]}, patient)
    word(hub, case, RigChanged(RIG))
    word(hub, case, ScanTaken(SCAN, RIG))
    invite(case, expert)
    case.invite(SECRETS[5])
    with case.enter() as room:
        room.draw(stroke("s"))
        room.submit()
        room.comment(SECRETS[4])
    return case


def on_disk(folder: Path, words: tuple[str, ...] = SECRETS) -> dict[str, list[str]]:
    """Which words are anywhere among the bytes of a hub's folder, and in which files."""
    found: dict[str, list[str]] = {}
    for path in folder.rglob("*"):
        if path.is_file():
            data = path.read_bytes()
            for w in words:
                if w.encode() in data:
                    found.setdefault(w, []).append(path.name)
    return found


def test_nothing_is_left_of_it_and_the_chain_holds(hub: Server, told: HubCase, sign_in: SignIn) -> None:
    data = hub.config.data
    own = with_file(hub, told, "own.json", b'"a mole like a heart"')
    other = scanned(hub, sign_in("operator"))
    shared = with_file(hub, told, "shared.json", b'"in two cases"')
    assert with_file(hub, other, "shared.json", b'"in two cases"') == shared
    laid = data / "laid-out" / told.id / "x"
    laid.mkdir(parents=True)
    (laid / "scan.json").write_text(SECRETS[3])
    assert set(on_disk(data)) == set(SECRETS), "else the search below would find nothing anyway"
    hub.site.checkpoints.write()
    before = told.events()
    done = sign_in("admin").case(told.id).erase("asked for in a letter of 3 May")
    assert (done.events, done.files) == (len(before), 1)
    assert on_disk(data) == {}
    assert not hub.site.blobs.has(own)
    assert hub.site.blobs.has(shared)
    assert not (data / "laid-out" / told.id).exists()
    found = judged(data)
    assert found.faults == ()
    after = told.events()
    assert [(e.seq, e.hash, e.kind) for e in after[:-1]] == [(e.seq, e.hash, e.kind) for e in before]
    assert all(e.payload is None for e in after[:-1])
    assert after[-1].kind == "erased"
    assert after[-1].payload == {"why": "asked for in a letter of 3 May", "through": len(before)}
    hub.site.checkpoints.write()
    hub.close()
    assert judged(data).faults == ()
    assert on_disk(data) == {}


def test_what_is_said_later_is_refused_and_not_kept(hub: Server, told: HubCase, sign_in: SignIn) -> None:
    sign_in("admin").case(told.id).erase("asked for")
    seq = told.get().seq
    said = told.say([{"client": "late", "number": 1, "what": {"kind": "comment", "comment": "c", "text": "too late"}}])
    assert said[0].refused == "the case was erased; open another"
    assert told.events(seq)[0].payload == {}
    assert judged(hub.config.data).faults == ()
    got = told.get()
    assert (got.status.value, got.patient, got.specimen.notes) == ("erased", None, "")
    assert told.state().strokes == {}
    assert told.state().standing["versions"] == []
    for attempt in (
        lambda: told.change(status="open"),
        lambda: told.scan(wait=False),
        lambda: told.invite("another"),
        lambda: told.bundle(hub.config.data / "x.zip"),
        lambda: sign_in("admin").case(told.id).erase("again"),
        lambda: invite(told, sign_in("expert")),
    ):
        with pytest.raises(HubError, match="erased") as e:
            attempt()
        assert e.value.status == 410
    assert not sign_in("operator").cases("S26-SECRET-1").cases
    assert [c.id for c in sign_in("operator").cases(status="erased").cases] == [told.id]


def test_people_in_the_room_are_told_and_let_go(hub: Server, told: HubCase, sign_in: SignIn) -> None:
    other = scanned(hub, sign_in("operator"))
    guest = told.invite("Guest", "observer")
    with Client(hub.url) as visitor:
        visitor.accept(guest.token or "", guest.code or "")
        with visitor.case(told.id).enter() as theirs, told.enter() as room, other.enter() as another:
            sign_in("admin").case(told.id).erase("asked for")
            for one in (theirs, room):
                end = time.monotonic() + 60
                while not one.closed and time.monotonic() < end:
                    time.sleep(0.01)
                assert "erased" in one.closed
                assert [e.kind for e in one.events][-1] == "erased"
            another.draw(stroke("goes on"))
        with pytest.raises(HubError) as e:
            visitor.case(told.id)
        assert e.value.status == 401, "a guest of the case is a guest no more"
    with pytest.raises(HubError) as e:
        sign_in("expert").case(told.id)
    assert e.value.status == 404


def test_it_stays_erased_after_a_new_start(hub: Server, told: HubCase, sign_in: SignIn) -> None:
    from fringescope.server.running import Server as Again

    sign_in("admin").case(told.id).erase("asked for")
    before = told.state()
    hub.close()
    with Again(hub.config, fast_passwords=True) as second, Client(second.url, "operator", PASSWORD) as operator:
        case = operator.case(told.id)
        assert case.state() == before
        op = {"client": "late", "number": 1, "what": {"kind": "comment", "comment": "c", "text": "too late"}}
        assert "erased" in case.say([op])[0].refused
    assert judged(hub.config.data).faults == ()


def test_only_an_administrator_erases_and_says_why(told: HubCase, sign_in: SignIn) -> None:
    for role in ("operator", "expert", "observer"):
        with pytest.raises(HubError) as e:
            HubCase(sign_in(role), told.id).erase("because")
        assert e.value.status == 403
    with pytest.raises(HubError) as e:
        sign_in("admin").case(told.id).erase("")
    assert e.value.status == 422
    assert told.get().status.value == "open"


def test_words_missing_beyond_the_erasure_are_still_found(hub: Server, told: HubCase, sign_in: SignIn) -> None:
    """An event that says "erased" is no licence for what came after it."""
    sign_in("admin").case(told.id).erase("asked for")
    op = {"client": "late", "number": 1, "what": {"kind": "comment", "comment": "c", "text": "too late"}}
    seq = told.say([op])[0].seq
    hub.close()
    by_hand(hub.config.data, f"DELETE FROM payloads WHERE case_id = '{told.id}' AND seq = {seq}")
    assert any(f"event {seq}: its words are missing" in f for f in judged(hub.config.data).faults)


def test_words_said_while_it_is_erased_are_before_it_or_refused(hub: Server, told: HubCase, sign_in: SignIn) -> None:
    over = threading.Event()

    def talk() -> None:
        with Client(hub.url, "operator", PASSWORD) as other:
            case, n = HubCase(other, told.id), 0
            while not over.is_set():
                what = [{"kind": "comment", "comment": f"c{n + k}", "text": f"chatter {n + k}"} for k in range(1, 9)]
                ops = [{"client": "busy", "number": n + k, "what": w} for k, w in enumerate(what, 1)]
                n += 8
                try:
                    case.say(ops)
                except HubError as e:
                    if e.status != 429:
                        raise
                    time.sleep(0.05)

    talking = threading.Thread(target=talk)
    talking.start()
    try:
        time.sleep(0.1)
        sign_in("admin").case(told.id).erase("asked for")
        time.sleep(0.1)
    finally:
        over.set()
        talking.join()
    events = []
    while page := told.events(len(events)):
        events += page
    at = next(e.seq for e in events if e.kind == "erased")
    assert at > len(SECRETS)
    assert all(e.payload is None for e in events if e.seq < at)
    assert all(e.payload == {} and e.refused for e in events if e.seq > at)
    assert on_disk(hub.config.data, ("chatter ",)) == {}
    assert judged(hub.config.data).faults == ()


def test_jobs_of_the_case_forget_what_they_found(hub: Server, told: HubCase, sign_in: SignIn) -> None:
    data = hub.config.data
    with closing(sqlite3.connect(data / "hub.sqlite")) as c, c:
        c.execute(
            "INSERT INTO jobs (id, kind, case_id, person_id, state, stage, share, why, result, created_ns) "
            "VALUES (?, 'carry', ?, 'p', 'done', '', 1, ?, ?, 1)",
            ("job-" + "0" * 20, told.id, "why of a heart", json.dumps({"strokes": "result of a heart"})),
        )
    sign_in("admin").case(told.id).erase("asked for")
    job = told.hub.ask("GET", "/api/jobs/job-" + "0" * 20)
    assert (job["result"], job["why"]) == (None, "")
    assert on_disk(data, ("of a heart",)) == {}


def test_a_backup_made_before_still_has_it(hub: Server, told: HubCase, sign_in: SignIn, tmp_path: Path) -> None:
    """As the documentation says: who erases throws old backups away."""
    from fringescope.server import backup

    backup.back_up(hub.config.data, tmp_path / "before.zip")
    sign_in("admin").case(told.id).erase("asked for")
    backup.back_up(hub.config.data, tmp_path / "after.zip")
    held = {}
    for name in ("before", "after"):
        with zipfile.ZipFile(tmp_path / f"{name}.zip") as z:
            held[name] = SECRETS[3].encode() in z.read("hub.sqlite")
    assert held == {"before": True, "after": False}


def test_what_is_projected_is_stopped_first(
    hub: Server, told: HubCase, sign_in: SignIn, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    monkeypatch.setattr(hub.site.hub, "lit", lambda case: case == told.id)
    with pytest.raises(HubError, match="stop it, then erase") as e:
        sign_in("admin").case(told.id).erase("asked for")
    assert e.value.status == 409
    assert told.state().strokes


@pytest.mark.parametrize("written", [True, False])
def test_an_erasure_that_was_killed_is_ended_by_the_next_start(
    hub: Server, told: HubCase, sign_in: SignIn, monkeypatch: pytest.MonkeyPatch, written: bool
) -> None:  # fmt: skip
    """Killed behind the event, before the files went; or before the event: then it did not happen."""
    from fringescope.errors import OutputError
    from fringescope.server import leaving

    data = hub.config.data
    sha256 = with_file(hub, told, "own.json", b'"a mole like a heart"')

    def killed(*_args: object, **_more: object) -> None:
        raise OutputError("killed")

    with monkeypatch.context() as m:
        if written:
            m.setattr(leaving, "sweep", killed)
        else:
            m.setattr(hub.site.hub, "note", killed)
        with pytest.raises(HubError, match="killed"):
            sign_in("admin").case(told.id).erase("asked for")
    assert list(data.glob("erasing-*"))
    assert hub.site.blobs.has(sha256)
    hub.close()
    with Server(hub.config, fast_passwords=True) as second:
        assert second.site.blobs.has(sha256) is not written
        with Client(second.url, "operator", PASSWORD) as again:
            assert again.case(told.id).get().status.value == ("erased" if written else "open")
    assert not list(data.glob("erasing-*"))
    assert (on_disk(data) == {}) is written
    assert judged(data).faults == ()
