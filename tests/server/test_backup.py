"""A hub kept elsewhere, while it runs, and back again with all that it knew."""

from __future__ import annotations

import json
import shutil
import sqlite3
import stat
import threading
import zipfile
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from fringescope import cli
from fringescope.client import Client, HubCase
from fringescope.errors import FormatError, OutputError
from fringescope.server import backup, cases
from fringescope.server import database as db
from fringescope.server.config import Config
from fringescope.server.running import Server
from fringescope.wire import ScanFile
from tests.server.conftest import PASSWORD, SignIn
from tests.server.test_audit import by_hand, judged
from tests.server.test_hub import invite, scanned, stroke


def with_file(hub: Server, case: HubCase, name: str, content: bytes) -> str:
    """A file of a case, as the instrument would keep one; its hash."""
    sha256, size = hub.site.blobs.put(content)
    with db.writing(hub.site.engine) as c:
        one = ScanFile(name=name, sha256=sha256, size=size, type="application/json")
        cases.insert_files(c, case.id, "version-1", [one])
    return sha256


@pytest.fixture
def kept(hub: Server, sign_in: SignIn) -> HubCase:
    """A case with words of two people and files."""
    case = scanned(hub, sign_in("operator"))
    expert = sign_in("expert")
    invite(case, expert)
    with case.enter() as a, expert.case(case.id).enter() as b:
        a.draw(stroke("o"))
        b.draw(stroke("e"))
        b.submit()
        a.comment("look here")
    with_file(hub, case, "pattern.json", b'{"strokes": []}')
    with_file(hub, case, "large.bin", bytes(range(256)) * 5000)
    case.change(patient={"name": "Ada Unlikely-Name", "identifier": "PID-556677", "born": ""})
    hub.site.checkpoints.write()
    return case


@pytest.mark.parametrize("name", ["kept.zip", "kept"])
def test_all_of_it_comes_back(hub: Server, kept: HubCase, tmp_path: Path, name: str) -> None:
    state, events, got = kept.state(), kept.events(), kept.get()
    (hub.config.data / "rigs").mkdir(exist_ok=True)
    (hub.config.data / "rigs" / "some.json").write_text("{}")
    made = backup.back_up(hub.config.data, tmp_path / "elsewhere" / name)
    assert (made.files, made.new, made.damaged) == (2, 2, [])
    kept.change(status="done")  # after the backup
    found = backup.restore(tmp_path / "elsewhere" / name, tmp_path / "restored")
    assert (found.faults, found.missing, found.files) == ((), [], 2)
    assert judged(tmp_path / "restored", files=True).whole
    assert (tmp_path / "restored" / "rigs" / "some.json").read_text() == "{}"
    with Server(Config(tmp_path / "restored", port=0), fast_passwords=True) as second:
        with Client(second.url, "operator", PASSWORD) as again:
            case = again.case(kept.id)
            assert case.state() == state
            assert case.events() == events
            assert case.get() == got
            assert case.get().patient is not None
            for files in again.ask("GET", f"/api/cases/{kept.id}/files").values():
                for f in files:
                    assert len(case.fetch(f["sha256"])) == f["size"]
            with case.enter() as room:
                room.draw(stroke("goes on"))
        assert second.site.checkpoints.key.private_bytes_raw() == hub.site.checkpoints.key.private_bytes_raw()
    assert judged(tmp_path / "restored", files=True).whole


def test_a_backup_opens_no_session_and_is_nobody_elses_to_read(hub: Server, kept: HubCase, tmp_path: Path) -> None:
    secret = kept.hub.http.cookies["fringescope"]
    backup.back_up(hub.config.data, tmp_path / "kept.zip")
    assert stat.S_IMODE((tmp_path / "kept.zip").stat().st_mode) == 0o600
    backup.back_up(hub.config.data, tmp_path / "kept")
    assert stat.S_IMODE((tmp_path / "kept").stat().st_mode) == 0o700
    backup.restore(tmp_path / "kept.zip", tmp_path / "restored")
    with closing(sqlite3.connect(tmp_path / "restored" / "hub.sqlite")) as c:
        assert c.execute("SELECT count(*) FROM sessions").fetchone() == (0,)
        assert c.execute("SELECT count(*) FROM people").fetchone() == (4,)
    assert secret
    assert stat.S_IMODE((tmp_path / "restored" / "audit-key.pem").stat().st_mode) == 0o600
    assert kept.get().id == kept.id, "the running hub keeps its own sessions"


def test_a_folder_takes_only_what_is_new(hub: Server, kept: HubCase, tmp_path: Path) -> None:
    out = tmp_path / "kept"
    first = backup.back_up(hub.config.data, out)
    again = backup.back_up(hub.config.data, out)
    assert (first.new, again.new, again.files) == (2, 0, 2)
    with_file(hub, kept, "third.json", b"{}")
    third = backup.back_up(hub.config.data, out)
    assert (third.new, third.files) == (1, 3)
    assert len(list((out / "files").glob("??/*"))) == 3
    assert backup.restore(out, tmp_path / "latest").files == 3
    assert backup.restore(Path(first.where), tmp_path / "first").files == 2
    assert not [p for p in out.iterdir() if p.name.startswith(".")], "nothing half made is left"


def test_while_people_draw_every_backup_is_one_instant(hub: Server, sign_in: SignIn, tmp_path: Path) -> None:
    case = scanned(hub, sign_in("operator"))
    over, drawn = threading.Event(), threading.Event()

    def draw() -> None:
        with case.enter() as room:
            k = 0
            while not over.wait(0.03):  # slower than anybody may
                room.draw(stroke(f"s{k % 50}", float(k)))
                drawn.set()
                k += 1

    drawing = threading.Thread(target=draw)
    drawing.start()
    try:
        counts = []
        for k in range(3):
            drawn.clear()
            assert drawn.wait(60)
            hub.site.checkpoints.write()
            backup.back_up(hub.config.data, tmp_path / f"{k}.zip")
            found = backup.restore(tmp_path / f"{k}.zip", tmp_path / f"restored-{k}")
            assert found.faults == ()
            counts.append(found.events)
    finally:
        over.set()
        drawing.join()
    assert counts == sorted(counts)
    assert counts[-1] > counts[0], "nobody drew meanwhile: this tests nothing"


def test_what_is_there_stays(hub: Server, kept: HubCase, tmp_path: Path) -> None:  # noqa: ARG001
    file = tmp_path / "kept.zip"
    backup.back_up(hub.config.data, file)
    with pytest.raises(OutputError, match="exists"):
        backup.back_up(hub.config.data, file)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").write_text("x")
    for place in ("full", "kept.zip"):
        with pytest.raises(OutputError, match="new or empty"):
            backup.restore(file, tmp_path / place)
    assert (tmp_path / "full" / "mine").read_text() == "x"
    (tmp_path / "empty").mkdir()
    assert backup.restore(file, tmp_path / "empty").faults == ()
    with pytest.raises(FormatError, match="no hub's database"):
        backup.back_up(tmp_path / "full", tmp_path / "n.zip")
    with pytest.raises(FormatError):
        backup.restore(tmp_path / "none.zip", tmp_path / "n")
    assert not (tmp_path / "n").exists()


def test_a_backup_that_was_altered_is_not_restored(hub: Server, kept: HubCase, tmp_path: Path) -> None:  # noqa: ARG001
    backup.back_up(hub.config.data, tmp_path / "kept.zip")
    with zipfile.ZipFile(tmp_path / "kept.zip") as z:
        files = {n: z.read(n) for n in z.namelist()}
    assert {"backup.json", "hub.sqlite", "audit-key.pem"} < set(files)

    def tried(changed: dict[str, bytes]) -> str:
        with zipfile.ZipFile(tmp_path / "x.zip", "w") as z:
            for n, data in changed.items():
                z.writestr(n, data)
        with pytest.raises(FormatError) as e:
            backup.restore(tmp_path / "x.zip", tmp_path / "restored")
        assert not (tmp_path / "restored").exists()
        assert not list(tmp_path.glob(".restored*"))
        return str(e.value)

    for name in files:
        if name != "backup.json":
            data = bytearray(files[name])
            data[len(data) // 2] ^= 1
            assert "altered or damaged" in tried({**files, name: bytes(data)}), name
    assert "missing" in tried({n: d for n, d in files.items() if n != "hub.sqlite"})
    doc = json.loads(files["backup.json"])
    assert "update it" in tried({**files, "backup.json": json.dumps({**doc, "version": 2}).encode()})
    for bad in ({"files": [{"path": "../../out", "sha256": "0" * 64, "size": 1}]}, {"files": 3},
                {"blobs": [["../x", 1]]}, {"database": "oracle"}, {"format": "x"}, {"blobs": [["a"]]}):  # fmt: skip
        assert tried({**files, "backup.json": json.dumps({**doc, **bad}).encode()})


def test_a_log_that_was_altered_before_is_told_at_the_restore(hub: Server, kept: HubCase, tmp_path: Path) -> None:
    hub.close()
    by_hand(hub.config.data, f"UPDATE events SET at_ns = 5 WHERE case_id = '{kept.id}' AND seq = 3")
    backup.back_up(hub.config.data, tmp_path / "kept.zip")
    found = backup.restore(tmp_path / "kept.zip", tmp_path / "restored")
    assert any(f"case {kept.id}, event 3" in f for f in found.faults)


def test_files_that_are_gone_from_the_disk_are_named(hub: Server, kept: HubCase, tmp_path: Path) -> None:
    gone = with_file(hub, kept, "gone.json", b"[1]")
    hurt = with_file(hub, kept, "hurt.json", b"[2]")
    hub.site.blobs.remove(gone)
    path = hub.site.blobs.path(hurt)
    path.chmod(0o640)
    path.write_bytes(b"[3]")
    for name in ("kept.zip", "kept"):
        made = backup.back_up(hub.config.data, tmp_path / name)
        assert set(made.damaged) == {gone, hurt}
        found = backup.restore(tmp_path / name, tmp_path / f"from-{name}")
        assert set(found.missing) == {gone, hurt}


def test_the_commands(hub: Server, kept: HubCase, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:  # noqa: ARG001
    def run(*args: str) -> tuple[int, Any]:
        capsys.readouterr()
        status = cli.run([*args, "--json"])
        out = capsys.readouterr().out
        return status, json.loads(out) if out.strip() else None

    data = str(hub.config.data)
    status, told = run("backup", "--data", data, "--out", str(tmp_path / "kept"))
    assert (status, told["files"], told["database"]) == (0, 2, "sqlite")
    status, told = run("restore", str(tmp_path / "kept"), "--data", str(tmp_path / "restored"))
    assert (status, told["faults"]) == (0, [])
    assert run("audit", "verify", "--data", str(tmp_path / "restored"), "--files")[0] == 0
    assert run("restore", str(tmp_path / "kept"), "--data", str(tmp_path / "restored"))[0] == 1
    shutil.rmtree(tmp_path / "kept" / "files")
    status, told = run("restore", str(tmp_path / "kept"), "--data", str(tmp_path / "other"))
    assert status == 1
    assert len(told["missing"]) == 2
