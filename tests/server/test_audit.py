"""Whatever somebody does to the log by hand is found and named, and nothing is said of a log that is whole."""

from __future__ import annotations

import json
import shutil
import sqlite3
import stat
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from fringescope import cli
from fringescope.client import HubCase
from fringescope.errors import FormatError
from fringescope.server import audit, checkpoints
from fringescope.server import database as db
from fringescope.server.running import Server
from tests.server.conftest import SignIn
from tests.server.test_hub import invite, scanned, stroke

TRIGGERS = ("events_no_update", "events_no_delete", "payloads_no_update")
CASES = 2


def write_log(hub: Server, sign_in: SignIn) -> list[HubCase]:
    """Two cases, each with words of two people, and a checkpoint behind them."""
    made = []
    for _ in range(CASES):
        case = scanned(hub, sign_in("operator"))
        expert = sign_in("expert")
        invite(case, expert)
        with case.enter() as a, expert.case(case.id).enter() as b:
            for k in range(3):
                a.draw(stroke(f"o{k}"))
                b.draw(stroke(f"e{k}", 10.0 * k))
            a.comment("look here")
        made.append(case)
    return made


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A hub's folder as it lies when the hub has ended."""
    from fringescope.client import Client
    from fringescope.server.config import Config
    from tests.server.conftest import PASSWORD, populate

    folder = tmp_path_factory.mktemp("audited") / "hub"
    opened: list[Client] = []
    with Server(Config(folder, port=0), fast_passwords=True) as server:
        populate(server)

        def enter(name: str) -> Client:
            opened.append(Client(server.url, name, PASSWORD))
            return opened[-1]

        write_log(server, enter)
        for client in opened:
            client.close()
    return folder


@pytest.fixture
def folder(pristine: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(pristine, tmp_path / "hub"))


def judged(folder: Path, *places: Path, key: str | None = None, files: bool = False) -> audit.Found:
    engine = audit.open_readonly(folder)
    try:
        return audit.verify(engine, folder, places, key, files)
    finally:
        engine.dispose()


def by_hand(folder: Path, *lines: str, **values: Any) -> int:
    """Raw SQL without the triggers; how many rows changed."""
    with closing(sqlite3.connect(folder / "hub.sqlite")) as c, c:
        for name in TRIGGERS:
            c.execute(f"DROP TRIGGER IF EXISTS {name}")
        return sum(c.execute(line, values).rowcount for line in lines)


def a_case(folder: Path, n: int = 0) -> str:
    with closing(sqlite3.connect(folder / "hub.sqlite")) as c:
        return str(sorted(r[0] for r in c.execute("SELECT id FROM cases"))[n])


def test_the_untouched_is_whole(folder: Path) -> None:
    found = judged(folder)
    assert found.faults == ()
    assert (found.cases, found.events) == (CASES, CASES * 11)
    assert found.checkpoints >= 1
    assert found.covered_ns > 0


COLUMNS = [("events", c.name) for c in db.events.columns] + [("payloads", c.name) for c in db.payloads.columns]


@pytest.mark.parametrize(("table", "column"), COLUMNS)
def test_any_column_altered_is_found(folder: Path, table: str, column: str) -> None:
    case = a_case(folder)
    kind = {c.name: c.type for c in (db.events if table == "events" else db.payloads).columns}[column]
    if isinstance(kind, sa.BigInteger):
        value: Any = f"{column} + 1000"
    elif column == "body":
        value = "replace(body, 'camera1', 'camera2')"
    else:
        value = f"{column} || 'x'"
    where = "seq = 6" if column != "kind" else "seq = 5"
    assert by_hand(folder, f"UPDATE {table} SET {column} = {value} WHERE case_id = '{case}' AND {where}") == 1
    found = judged(folder)
    assert not found.whole
    assert any(case in f for f in found.faults), found.faults
    assert not any(a_case(folder, 1) in f for f in found.faults), "the other case is whole"
    alone = [f for f in found.faults if not f.startswith("checkpoint")]
    assert alone, "found without checkpoints, too"


@pytest.mark.verify
@pytest.mark.parametrize(("table", "column"), COLUMNS)
def test_any_column_of_any_event_altered_is_found(folder: Path, table: str, column: str) -> None:
    case = a_case(folder)
    kind = {c.name: c.type for c in (db.events if table == "events" else db.payloads).columns}[column]
    for seq in range(1, 12):
        at = f"WHERE case_id = '{case}' AND seq = {seq}"
        with closing(sqlite3.connect(folder / "hub.sqlite")) as c:
            before = c.execute(f"SELECT {column} FROM {table} {at}").fetchone()[0]
        value: Any = f"{column} + 100000" if isinstance(kind, sa.BigInteger) else f"{column} || ' '"
        if column == "body":
            value = "replace(body, '{', '{\"x\": 1, ')" if before != "{}" else "'{\"x\": 1}'"
        if column == "seq":
            value = 500
        assert by_hand(folder, f"UPDATE {table} SET {column} = {value} {at}") == 1
        assert any(case in f for f in judged(folder).faults), seq
        moved = f"WHERE case_id = '{case}' AND seq = 500" if column == "seq" else at
        moved = f"WHERE case_id = '{case} ' AND seq = {seq}" if column == "case_id" else moved
        assert by_hand(folder, f"UPDATE {table} SET {column} = :before {moved}", before=before) == 1
        assert judged(folder).whole


def test_a_checkpoint_on_a_full_disk_is_written_whole_or_not(
    hub: Server, sign_in: SignIn, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    import os

    from fringescope.errors import OutputError

    case = scanned(hub, sign_in("operator"))
    hub.site.checkpoints.write()
    before = the_file(hub.config.data).read_bytes()
    case.change(status="done")

    def full(_number: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as m:
        m.setattr(os, "fsync", full)
        with pytest.raises(OutputError, match="No space left"):
            hub.site.checkpoints.write()
    assert the_file(hub.config.data).read_bytes() == before
    hub.site.checkpoints.write()
    assert len(the_file(hub.config.data).read_text().splitlines()) == 2
    assert judged(hub.config.data).whole


@pytest.mark.parametrize("value", ["'abc'", "NULL", "x'ff'", "1e300", "-1"])
def test_values_of_another_kind_are_found_and_break_nothing(folder: Path, value: str) -> None:
    case = a_case(folder)
    for column in ("at_ns", "refused", "hash"):
        by_hand(folder, "PRAGMA ignore_check_constraints = 1")
        try:
            by_hand(folder, f"UPDATE events SET {column} = {value} WHERE case_id = '{case}' AND seq = 4")
        except sqlite3.IntegrityError:
            assert value == "NULL"
            continue
        assert any(case in f for f in judged(folder).faults)


@pytest.mark.parametrize("body", ["", "null", "[]", "{", '{"a": NaN}', "7", "{}"])
def test_words_that_are_no_words_are_found(folder: Path, body: str) -> None:
    case = a_case(folder)
    by_hand(folder, f"UPDATE payloads SET body = :body WHERE case_id = '{case}' AND seq = 7", body=body)
    assert any(f"case {case}, event 7: its words were altered" in f for f in judged(folder).faults)


@pytest.mark.parametrize("seq", range(1, 12))
def test_any_event_removed_is_found(folder: Path, seq: int) -> None:
    case = a_case(folder)
    gone = f"WHERE case_id = '{case}' AND seq = {seq}"
    assert by_hand(folder, f"DELETE FROM payloads {gone}", f"DELETE FROM events {gone}") == 2
    assert any(case in f for f in judged(folder).faults)


def test_words_removed_without_an_erasure_are_found(folder: Path) -> None:
    case = a_case(folder)
    by_hand(folder, f"DELETE FROM payloads WHERE case_id = '{case}' AND seq = 5")
    assert judged(folder).faults == (
        f"case {case}, event 5: its words are missing and no event says that they were erased",
    )


def test_two_events_that_changed_places_are_found(folder: Path) -> None:
    case = a_case(folder)
    for table in ("events", "payloads"):
        at = f"WHERE case_id = '{case}' AND seq"
        by_hand(folder, *(f"UPDATE {table} SET seq = {b} {at} = {a}" for a, b in ((6, 99), (7, 6), (99, 7))))
    found = judged(folder).faults
    assert any(f"case {case}, event 6" in f for f in found)
    assert any(f"case {case}, event 7" in f for f in found)


def test_an_event_between_others_is_found(folder: Path) -> None:
    case = a_case(folder)
    kept = ", ".join(c.name for c in db.events.columns if c.name != "seq")
    made = kept.replace("number", "number + 500")
    by_hand(
        folder,
        f"UPDATE payloads SET seq = seq + 1000 WHERE case_id = '{case}' AND seq > 6",
        f"UPDATE events SET seq = seq + 1000 WHERE case_id = '{case}' AND seq > 6",
        f"INSERT INTO events (seq, {kept}) SELECT 7, {made} FROM events WHERE case_id = '{case}' AND seq = 6",
        f"INSERT INTO payloads SELECT case_id, 7, salt, body FROM payloads WHERE case_id = '{case}' AND seq = 6",
        f"UPDATE payloads SET seq = seq - 999 WHERE case_id = '{case}' AND seq > 1000",
        f"UPDATE events SET seq = seq - 999 WHERE case_id = '{case}' AND seq > 1000",
    )
    assert any(f"case {case}, event 7" in f for f in judged(folder).faults)


def cut(folder: Path, case: str, after: int) -> None:
    by_hand(folder, *(f"DELETE FROM {t} WHERE case_id = '{case}' AND seq > {after}" for t in ("payloads", "events")))


def test_a_cut_tail_is_found_by_the_checkpoint_alone(folder: Path) -> None:
    case = a_case(folder)
    cut(folder, case, 8)
    assert any(f"case {case}: its log ends with event 8" in f and "event 11" in f for f in judged(folder).faults)
    shutil.rmtree(folder / "checkpoints")
    assert judged(folder).whole, "a chain cannot show that its tail is missing: the test would not test checkpoints"


def test_a_log_rewritten_from_an_event_on_is_found(folder: Path) -> None:
    """Somebody who computes all hashes anew is found by the checkpoint, and only there."""
    from fringescope.server import journal
    from fringescope.wire.record import link

    case = a_case(folder)
    engine = audit.open_readonly(folder)
    records = list(journal.entries(engine, case))
    engine.dispose()
    prev, made = records[4].hash, []
    for r in records[5:]:
        forged = link(r, prev) if r.seq != 6 else link(r.__class__(**{**vars(r), "said_ns": 1}), prev)
        prev = forged.hash
        made.append(forged)
    for r in made:
        by_hand(
            folder,
            f"UPDATE events SET said_ns = {r.said_ns}, prev = '{r.prev}', hash = '{r.hash}', digest = '{r.digest}' "
            f"WHERE case_id = '{case}' AND seq = {r.seq}",
        )
    found = judged(folder).faults
    assert len(found) == 1
    assert "rewritten" in found[0]
    assert f"case {case}, event 11" in found[0]


def test_a_whole_case_that_was_removed_is_found(folder: Path) -> None:
    case = a_case(folder)
    cut(folder, case, 0)
    by_hand(folder, f"DELETE FROM members WHERE case_id = '{case}'")
    assert any(f"case {case}: it has no event" in f for f in judged(folder).faults)
    by_hand(folder, f"DELETE FROM cases WHERE id = '{case}'")
    assert any(f"case {case}: it is missing" in f and "11 events" in f for f in judged(folder).faults)


def test_events_without_their_case_are_found(folder: Path) -> None:
    case = a_case(folder)
    by_hand(folder, f"DELETE FROM cases WHERE id = '{case}'")
    assert any(f"case {case}: there are events of it and no case" in f for f in judged(folder).faults)


# -------------------------------------------------------------------------------------------------------- checkpoints


def the_file(folder: Path) -> Path:
    return next((folder / "checkpoints").glob("*.jsonl"))


def test_forged_checkpoints_are_found(folder: Path, tmp_path: Path) -> None:
    file = the_file(folder)
    lines = file.read_text().splitlines()
    doc = json.loads(lines[0])
    case = a_case(folder)
    for change in ({"at_ns": 7}, {"heads": {}}, {"heads": {case: [1, "0" * 64]}}, {"key": "0" * 64}, {"whole": False},
                   {"signature": "00"}, {"signature": 3}, {"key": None}):  # fmt: skip
        file.write_text(json.dumps({**doc, **change}) + "\n")
        assert any("signature does not fit" in f for f in judged(folder).faults), change
    for text in ("[]", "null", "{", '{"format": "fringescope-checkpoint"}', "[" * 100_000):
        file.write_text(text + "\n")
        assert not judged(folder).whole
    other = tmp_path / "other"
    other.mkdir()
    forged = {k: v for k, v in doc.items() if k not in ("key", "signature")}
    file.write_text(json.dumps(checkpoints.signed(forged, checkpoints.own_key(other))) + "\n")
    assert any("another key than the hub's" in f for f in judged(folder).faults)


def test_a_key_that_was_swapped_with_all_that_it_signed_is_found_by_the_key_kept_elsewhere(
    folder: Path, tmp_path: Path
) -> None:  # fmt: skip
    public = tmp_path / "public.pem"
    assert cli.run(["audit", "key", "--data", str(folder), "--out", str(public)]) == 0
    kept = checkpoints.raw(checkpoints.read_public(public))
    assert judged(folder, key=kept).whole
    for name in (checkpoints.KEY, checkpoints.PUBLIC):
        (folder / name).unlink()
    shutil.rmtree(folder / "checkpoints")
    cut(folder, a_case(folder), 8)
    engine = audit.open_readonly(folder)
    checkpoints.export(engine, checkpoints.own_key(folder), folder / "checkpoints", 1)
    engine.dispose()
    assert judged(folder).whole, "all of it was made to fit"
    assert any("another key" in f for f in judged(folder, key=kept).faults)


def test_a_line_taken_out_of_the_middle_is_found(hub: Server, sign_in: SignIn) -> None:
    case = scanned(hub, sign_in("operator"))
    points = hub.site.checkpoints
    with case.enter() as room:
        for k in range(3):
            room.draw(stroke(f"s{k}"))
            points.write()
    assert points.write() is None, "nothing has moved since"
    file = the_file(hub.config.data)
    lines = file.read_text().splitlines()
    assert [json.loads(x)["whole"] for x in lines] == [True, False, False]
    assert judged(hub.config.data).whole
    file.write_text(lines[0] + "\n" + lines[2] + "\n")
    assert any("does not follow the line before" in f for f in judged(hub.config.data).faults)


def test_what_a_power_cut_left_of_a_line_goes(hub: Server, sign_in: SignIn) -> None:
    case = scanned(hub, sign_in("operator"))
    hub.site.checkpoints.write()
    file = the_file(hub.config.data)
    with file.open("a") as f:
        f.write('{"at_ns":12')
    assert judged(hub.config.data).whole
    with case.enter() as room:
        room.draw(stroke("s"))
    hub.site.checkpoints.write()
    assert len(file.read_text().splitlines()) == 2
    found = judged(hub.config.data)
    assert (found.faults, found.checkpoints) == ((), 2)


def test_the_key_is_nobody_elses_to_read_and_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import os

    modes = []
    real = os.open

    def watched(path: Any, flags: int, mode: int = 0o777, **more: Any) -> int:
        number = real(path, flags, mode, **more)
        if checkpoints.KEY in str(path):
            modes.append(stat.S_IMODE(os.fstat(number).st_mode))
        return number

    monkeypatch.setattr(os, "open", watched)
    first = checkpoints.own_key(tmp_path)
    assert modes == [0o600], "from its first byte"
    assert stat.S_IMODE((tmp_path / checkpoints.KEY).stat().st_mode) == 0o600
    assert checkpoints.raw(first.public_key()) == checkpoints.raw(checkpoints.own_key(tmp_path).public_key())
    assert sorted(p.name for p in tmp_path.iterdir()) == [checkpoints.KEY, checkpoints.PUBLIC]
    (tmp_path / checkpoints.KEY).write_bytes(b"nonsense")
    with pytest.raises(FormatError, match="restore it from a backup"):
        checkpoints.own_key(tmp_path)


# ---------------------------------------------------------------------------------------------- beside a running hub


def test_a_running_hub_is_judged_without_its_lock_and_nothing_is_written(hub: Server, sign_in: SignIn) -> None:
    cases = write_log(hub, sign_in)
    hub.site.checkpoints.write()
    data = hub.config.data
    with cases[0].enter() as room:
        room.draw(stroke("later"))
        found = judged(data)
        assert found.faults == ()
        assert (found.cases, found.events) == (CASES, CASES * 11 + 1)
        engine = audit.open_readonly(data)
        with pytest.raises(sa.exc.OperationalError), engine.begin() as c:
            c.exec_driver_sql("DELETE FROM payloads")
        engine.dispose()
        room.draw(stroke("and later"))
    report = sign_in("admin").ask("GET", "/api/audit")
    assert report["whole"]
    assert report["checkpoints"] >= 1


def test_the_hub_writes_checkpoints_as_it_runs_and_when_it_ends(tmp_path: Path) -> None:
    import time

    from fringescope.client import Client
    from fringescope.server.config import Config
    from tests.server.conftest import PASSWORD, populate

    data = tmp_path / "hub"
    with Server(Config(data, port=0, checkpoint_s=0.05), fast_passwords=True) as server:
        populate(server)
        with Client(server.url, "operator", PASSWORD) as operator:
            case = scanned(server, operator)
            end = time.monotonic() + 20
            while not (data / "checkpoints").is_dir() and time.monotonic() < end:
                time.sleep(0.02)
            assert the_file(data).is_file()
            case.change(status="done")
    last = json.loads(the_file(data).read_text().splitlines()[-1])
    assert last["heads"][case.id][0] == 4, "the last words before the end are in it"
    assert judged(data).whole


def test_the_triggers_refuse_by_themselves(folder: Path) -> None:
    with closing(sqlite3.connect(folder / "hub.sqlite")) as c:
        for line in ("UPDATE events SET at_ns = 1", "DELETE FROM events", "UPDATE payloads SET salt = ''",
                     "UPDATE events SET refused = 'x' WHERE seq = 3", "DELETE FROM events WHERE seq = 11"):  # fmt: skip
            with pytest.raises(sqlite3.IntegrityError, match="only ever added to"):
                c.execute(line)


# ------------------------------------------------------------------------------------------------------- command line


@pytest.fixture
def told(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, Any]]:
    def run(*args: str) -> tuple[int, Any]:
        capsys.readouterr()
        status = cli.run(["audit", *args, "--json"])
        out = capsys.readouterr().out
        return status, json.loads(out) if out.strip() else None

    return run


def test_the_command_tells_whole_from_not_whole(folder: Path, tmp_path: Path, told: Any) -> None:
    elsewhere = tmp_path / "elsewhere"
    status, made = told("checkpoint", "--data", str(folder), "--out", str(elsewhere))
    assert status == 0
    status, found = told("verify", "--data", str(folder), "--checkpoints", str(elsewhere), "--files")
    assert (status, found["whole"], found["faults"]) == (0, True, [])
    shutil.rmtree(folder / "checkpoints")
    cut(folder, a_case(folder), 5)
    assert told("verify", "--data", str(folder))[0] == 0
    for place in (elsewhere, Path(made["checkpoint"])):
        status, found = told("verify", "--data", str(folder), "--checkpoints", str(place))
        assert status == 1
        assert any("tail was cut off" in f for f in found["faults"])
    assert told("verify", "--data", str(folder), "--checkpoints", str(tmp_path / "none"))[0] == 1
    assert told("verify", "--data", str(tmp_path))[0] == 1
    assert told("nonsense", "--data", str(folder))[0] == 2
    assert told("checkpoint", "--data", str(folder))[0] == 2
