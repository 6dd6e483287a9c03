"""A case leaves as one file and comes back the same; what was altered on the way does not come in."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from fringescope import export, store
from fringescope.client import Client, HubCase, HubError
from fringescope.server import audit, checkpoints
from fringescope.server.config import Config, Limits
from fringescope.server.running import Server
from fringescope.wire.record import canonical
from tests.server.conftest import PASSWORD, SignIn, populate
from tests.server.test_hub import invite

SPECIMEN = {"pseudonym": "T-17", "organ": "tongue", "side": "left", "kind": "excision", "notes": "two stitches at 12 h"}
PATIENT = {"name": "Ada Unlikely-Name", "identifier": "PID-556677", "born": "1931-02-03"}


def a_full_case(operator: Client, expert: Client, scan: Path) -> HubCase:
    """A case with a scan, strokes of two people, a submission, comments and a signature."""
    case = operator.open_case("S26-4711", SPECIMEN, PATIENT)
    case.add_scan(scan, "before the cut")
    invite(case, expert)
    doc = json.loads((scan / "scan.json").read_text())
    w, h = doc["views"][0]["size"]
    cloud = export.read_ply(scan / "cloud.ply").xyz
    top = cloud[cloud[:, 2] > cloud[:, 2].max() - 2]
    with case.enter() as a, expert.case(case.id).enter() as b:
        line = [[0.35 * w + 0.3 * w * k / 20, 0.5 * h] for k in range(21)]
        b.draw({"id": "cut-1", "camera": "camera1", "pixels": line, "width_mm": 0.8, "color": "#ffffff"})
        b.draw({"id": "cut-2", "world_mm": top[:2].tolist(), "width_mm": 0.8, "color": "#30ff30"})
        version = b.submit()
        b.draw({"id": "later", "kind": "arrow", "camera": "camera2", "pixels": [[60, 40], [90, 60]], "width_mm": 1})
        a.comment("is the margin wide enough here?", stroke="cut-1")
        b.comment("yes: 5 mm, I would say")
        a.sign(version, "approved")
        b.sign(version, "proposed")
    return case


def photographed(server: Server, case: HubCase) -> None:
    """As if version 1 had been projected: the instrument's photograph of it goes into the case."""
    import asyncio

    from fringescope.server import cases
    from fringescope.wire import ScanFile

    photo = next(f for f in case.scans()[0].files if f.name == "photo-camera1.jpg")
    files = [ScanFile(name="camera1.jpg", sha256=photo.sha256, size=photo.size, type="image/jpeg")]
    word = {"version": 1, "pattern": "p", "shown_ns": 1_700_000_000 * 10**9, "pictures": {"camera1.jpg": photo.sha256}}
    assert server.loop is not None
    noted = server.site.hub.note(
        case.id, "instrument", "instrument", "evidence", word,
        lambda c: cases.insert_files(c, case.id, "evidence-1700000000000000000", files),
    )  # fmt: skip
    assert not asyncio.run_coroutine_threadsafe(noted, server.loop).result(10).refused


@pytest.fixture(scope="module")
def exported(scan_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """A bundle, and what its hub says of the case."""
    at = tmp_path_factory.mktemp("exporting")
    with Server(Config(at / "hub", port=0), fast_passwords=True) as server:
        populate(server)
        with Client(server.url, "operator", PASSWORD) as operator, Client(server.url, "expert", PASSWORD) as expert:
            case = a_full_case(operator, expert, scan_folder)
            photographed(server, case)
            told = {"file": case.bundle(at / "bundle.zip"), "state": case.state(), "case": case.get(), "at": at,
                    "events": case.events(), "scans": case.scans(), "hub": server, "id": case.id}  # fmt: skip
            told["named"] = case.bundle(at / "named.zip", patient=True)
            told["expert"] = expert.me.person.id
            yield told


@pytest.fixture
def file(exported: dict[str, Any]) -> Path:
    return Path(exported["file"])


def test_it_holds_what_people_and_programs_need(file: Path, scan_folder: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(file) as z:
        assert z.testzip() is None
        z.extractall(tmp_path)
        names = set(z.namelist())
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert (manifest["format"], manifest["version"]) == ("fringescope-bundle", 1)
    assert {f["path"] for f in manifest["files"]} == names - {"manifest.json"}
    for f in manifest["files"]:
        data = (tmp_path / f["path"]).read_bytes()
        assert (hashlib.sha256(data).hexdigest(), len(data)) == (f["sha256"], f["size"])
    scan = tmp_path / "scans" / "1"
    assert store.read_scan(scan).document["hash"] == json.loads((scan_folder / "scan.json").read_text())["hash"]
    glb = export.read_glb(scan / "surface.glb")
    stl = (scan / "surface.stl").read_bytes()
    assert int.from_bytes(stl[80:84], "little") == glb.n_faces > 100
    assert len(export.read_ply(scan / "cloud.ply").xyz) > 1000
    assert {p.name for p in scan.glob("photo-*.jpg")} == {f"photo-camera{k}.jpg" for k in (1, 2, 3)}
    asked = store.read_guidelines(tmp_path / "strokes" / "version-1.json")
    assert [s.id for s in asked.strokes] == ["cut-1", "cut-2"]
    draft = store.read_guidelines(tmp_path / "strokes" / "draft-scan-1.json")
    assert {s.id for s in draft.strokes} == {"cut-1", "cut-2", "later"}


def test_its_log_is_the_log_and_its_chain_holds_without_this_program(file: Path, exported: dict[str, Any]) -> None:
    with zipfile.ZipFile(file) as z:
        lines = [json.loads(x) for x in z.read("events.jsonl").splitlines()]
        manifest = json.loads(z.read("manifest.json"))
    assert [(x["seq"], x["hash"]) for x in lines] == [(e.seq, e.hash) for e in exported["events"]]
    prev = "0" * 64
    for x in lines:  # the chain as docs describe it, by hand

        def plain(v: Any) -> bytes:
            return json.dumps(v, sort_keys=True, separators=(",", ":")).encode()

        assert x["digest"] == hashlib.sha256(x["salt"].encode() + b"\n" + plain(x["payload"])).hexdigest()
        keys = ("case", "seq", "at_ns", "said_ns", "actor", "role", "client", "number", "kind", "refused", "digest")
        prev = hashlib.sha256(plain([*(x[k] for k in keys), prev])).hexdigest()
        assert x["hash"] == prev
    assert (manifest["seq"], manifest["head"]) == (len(lines), prev)


def everything(file: Path, tmp_path: Path) -> bytes:
    """All bytes that are in a bundle, those of the report as text."""
    with zipfile.ZipFile(file) as z:
        z.extract("report.pdf", tmp_path)
        rest = b"\n".join(z.read(n) for n in z.namelist() if n.endswith((".json", ".jsonl")))
    return rest + text_of(tmp_path / "report.pdf").encode()


def text_of(pdf: Path) -> str:
    if shutil.which("pdftotext") is None:
        pytest.skip("pdftotext is not here")
    out = subprocess.run(["pdftotext", "-layout", str(pdf), "-"], capture_output=True, check=True)
    return out.stdout.decode()


def test_nobody_is_named_unless_an_operator_asks(exported: dict[str, Any], tmp_path: Path) -> None:
    for key, there in (("file", False), ("named", True)):
        data = everything(exported[key], tmp_path)
        for word in PATIENT.values():
            assert (word.encode() in data) is there, (key, word)
        assert b"T-17" in data


def test_who_may_take_it(exported: dict[str, Any], tmp_path: Path) -> None:
    hub, case = exported["hub"], exported["id"]
    with Client(hub.url, "expert", PASSWORD) as expert:
        assert HubCase(expert, case).bundle(tmp_path / "e.zip").stat().st_size > 10_000
        with pytest.raises(HubError, match=r"name the patient") as e:
            HubCase(expert, case).bundle(tmp_path / "f.zip", patient=True)
        assert e.value.status == 403
    assert not (tmp_path / "f.zip").exists()
    for role in ("observer", "admin"):
        with Client(hub.url, role, PASSWORD) as other, pytest.raises(HubError) as e:
            HubCase(other, case).bundle(tmp_path / "g.zip")
        assert e.value.status == 403
    assert not list((hub.config.data / "work").glob("*")), "nothing of it is left lying on the hub"


def test_the_report_tells_all_of_it(file: Path, tmp_path: Path, exported: dict[str, Any]) -> None:
    with zipfile.ZipFile(file) as z:
        z.extract("report.pdf", tmp_path)
        specimen = json.loads(z.read("scans/1/scan.json"))["figures"]["specimen"]["pieces"][0]
    text = text_of(tmp_path / "report.pdf")
    flat = " ".join(text.split())
    content = exported["state"].standing["versions"][0]["content"]
    pages = text.count("\f")
    assert pages >= 2
    for k in range(1, pages + 1):
        assert f"page {k} of {pages}" in flat
    assert flat.count("Research use only.") >= pages
    told = [
        "S26-4711", "T-17", "tongue", "two stitches at 12 h", "before the cut",
        f"{specimen['volume_mm3']:.1f} mm³", f"± {specimen['volume_sigma_mm3']:.1f} mm³",
        f"{specimen['length_mm']:.2f} mm", "is the margin wide enough here?", "yes: 5 mm, I would say",
        "projected on the specimen, 2023-11-14 22:13:20 UTC: camera1",
        "approved, version 1", "proposed, version 1", exported["case"].id,
    ]  # fmt: skip
    for words in told:
        assert words in flat, words
    signed = text[text.index("Signatures") :]
    assert content in signed
    assert "operator" in signed
    assert "expert" in signed


# ---------------------------------------------------------------------------------------------------------- back in


Import = Callable[[Path], HubCase]


@pytest.fixture
def elsewhere(sign_in: SignIn) -> Client:
    """An operator of another hub."""
    return sign_in("operator")


@pytest.fixture(scope="module")
def untouched(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A hub into which nothing comes: what is tried there is refused."""
    with Server(Config(tmp_path_factory.mktemp("untouched") / "hub", port=0), fast_passwords=True) as server:
        populate(server)
        yield server


@pytest.fixture
def doubtful(untouched: Server) -> Iterator[Client]:
    """Its operator."""
    untouched.site.logins._buckets.clear()
    with Client(untouched.url, "operator", PASSWORD) as client:
        yield client


def test_it_comes_back_the_same(exported: dict[str, Any], elsewhere: Client, hub: Server, tmp_path: Path) -> None:
    case = elsewhere.import_case(exported["file"])
    assert case.id == exported["id"]
    before, after = exported["state"], case.state()
    assert after.model_copy(update={"seq": before.seq}) == before
    assert after.seq == before.seq + 1
    events = case.events()
    assert events[:-1] == exported["events"]
    assert (events[-1].kind, events[-1].actor) == ("imported", elsewhere.me.person.id)
    assert events[-1].payload is not None
    assert not events[-1].payload["own"]
    assert case.scans() == exported["scans"]
    for f in case.scans()[0].files:
        assert hashlib.sha256(case.fetch(f.sha256)).hexdigest() == f.sha256
    got = case.get()
    assert (got.accession, got.specimen, got.patient) == ("S26-4711", exported["case"].specimen, None)
    engine = audit.open_readonly(hub.config.data)
    assert audit.verify(engine, hub.config.data, files=True).faults == ()
    engine.dispose()
    with case.enter() as room:
        room.comment("goes on here")
    again = case.bundle(tmp_path / "again.zip")
    with zipfile.ZipFile(again) as z:
        manifest = json.loads(z.read("manifest.json"))
        old = zipfile.ZipFile(exported["file"])
        assert z.read("events.jsonl").startswith(old.read("events.jsonl"))
        old.close()
    assert manifest["people"][exported["expert"]]["name"] == "expert", "printed names travel on"


def test_the_patient_comes_back_if_the_bundle_names_them(exported: dict[str, Any], elsewhere: Client) -> None:
    assert elsewhere.import_case(exported["named"]).get().patient is not None


def test_twice_it_is_here_already(exported: dict[str, Any], elsewhere: Client) -> None:
    case = elsewhere.import_case(exported["file"])
    with pytest.raises(HubError, match="is here already") as e:
        elsewhere.import_case(exported["file"])
    assert e.value.status == 409
    with Client(exported["hub"].url, "operator", PASSWORD) as home, pytest.raises(HubError, match="here already"):
        home.import_case(exported["file"])
    assert len(case.events()) == len(exported["events"]) + 1


def test_only_operators_bring_cases_in(exported: dict[str, Any], sign_in: SignIn) -> None:
    for role in ("expert", "observer", "admin"):
        with pytest.raises(HubError) as e:
            sign_in(role).import_case(exported["file"])
        assert e.value.status == 403


def test_what_was_checked_elsewhere_is_not_shown_here(exported: dict[str, Any], elsewhere: Client) -> None:
    case = elsewhere.import_case(exported["file"])
    with case.enter() as room, pytest.raises(HubError, match="checked on another instrument"):
        room.preview(1)


# --------------------------------------------------------------------------------------------------- what was altered


def altered(file: Path, to: Path, change: Callable[[dict[str, bytes]], Any], sign: bool = False) -> Path:
    """The bundle with its files changed; with `sign` the manifest is made to fit and signed by somebody else."""
    with zipfile.ZipFile(file) as z:
        files = {n: z.read(n) for n in z.namelist()}
    change(files)
    if sign:
        doc = json.loads(files["manifest.json"])
        for f in doc["files"]:
            if f["path"] in files:
                f["sha256"], f["size"] = hashlib.sha256(files[f["path"]]).hexdigest(), len(files[f["path"]])
        forger = checkpoints.own_key(to.parent)
        doc = checkpoints.signed({k: v for k, v in doc.items() if k not in ("key", "signature")}, forger)
        files["manifest.json"] = json.dumps(doc).encode()
    with zipfile.ZipFile(to, "w") as z:
        for n, data in files.items():
            z.writestr(n, data)
    return to


def refused(doubtful: Client, file: Path) -> str:
    with pytest.raises(HubError) as e:
        doubtful.import_case(file)
    assert e.value.status == 400, e.value
    assert doubtful.cases().total == 0
    return str(e.value)


def flip(name: str) -> Callable[[dict[str, bytes]], None]:
    def change(files: dict[str, bytes]) -> None:
        data = bytearray(files[name])
        data[len(data) // 2] ^= 1
        files[name] = bytes(data)

    return change


def test_one_bit_of_any_file_is_noticed(file: Path, doubtful: Client, untouched: Server, tmp_path: Path) -> None:
    with zipfile.ZipFile(file) as z:
        names = z.namelist()
    for name in [*names[:: max(1, len(names) // 8)], "events.jsonl", "report.pdf", "scans/1/surface.glb"]:
        if name != "manifest.json":
            assert "altered" in refused(doubtful, altered(file, tmp_path / "x.zip", flip(name)))
    assert not list((untouched.config.data / "files").glob("??/*")), "nothing of them was kept"


def in_manifest(**values: Any) -> Callable[[dict[str, bytes]], None]:
    def change(files: dict[str, bytes]) -> None:
        doc = json.loads(files["manifest.json"])
        files["manifest.json"] = json.dumps({**doc, **values}).encode()

    return change


def test_a_manifest_that_was_altered_or_is_of_another_kind(file: Path, doubtful: Client, tmp_path: Path) -> None:
    def tried(change: Callable[[dict[str, bytes]], Any], sign: bool = False) -> str:
        return refused(doubtful, altered(file, tmp_path / "x.zip", change, sign))

    assert "signature" in tried(in_manifest(made_ns=5))
    assert "higher than this program reads" in tried(in_manifest(version=2))
    assert "version" in tried(in_manifest(version="one"))
    assert "no bundle" in tried(in_manifest(format="fringescope-scan"))
    assert "not in order" in tried(in_manifest(case={"id": "../x"}), True)
    assert "missing" in tried(lambda f: f.pop("manifest.json"))
    assert "missing" in tried(lambda f: f.pop("scans/1/surface.glb"))
    assert "does not list" in tried(lambda f: f.update({"more.txt": b"x"}))
    assert "no JSON" in tried(lambda f: f.update({"manifest.json": b"{" * 10_000}))
    assert "no JSON object" in tried(lambda f: f.update({"manifest.json": b"[1]"}))


def in_log(change: Callable[[list[dict[str, Any]]], Any], relink: bool = False) -> Callable[[dict[str, bytes]], None]:
    """The log changed; with `relink` all hashes are made to fit."""

    def changed(files: dict[str, bytes]) -> None:
        lines = [json.loads(x) for x in files["events.jsonl"].splitlines()]
        change(lines)
        doc = json.loads(files["manifest.json"])
        if relink:
            prev = "0" * 64
            for x in lines:
                x["digest"] = hashlib.sha256(x["salt"].encode() + b"\n" + canonical(x["payload"])).hexdigest()
                x["prev"] = prev
                keys = ("case", "seq", "at_ns", "said_ns", "actor", "role", "client", "number", "kind", "refused",
                        "digest")  # fmt: skip
                prev = x["hash"] = hashlib.sha256(canonical([*(x[k] for k in keys), prev])).hexdigest()
            doc["seq"], doc["head"] = len(lines), prev
        files["events.jsonl"] = b"".join(canonical(x) + b"\n" for x in lines)
        files["manifest.json"] = json.dumps(doc).encode()

    return changed


LOGS: dict[str, tuple[Callable[[list[dict[str, Any]]], Any], bool, str]] = {
    "an altered word": (lambda x: x[3]["payload"].update(a=1), False, "words were altered"),
    "an altered time": (lambda x: x[3].update(at_ns=1), False, "hash does not fit"),
    "one left out": (lambda x: x.pop(9), False, "removed, added or moved"),
    "the tail cut off": (lambda x: x.pop(), False, "it was cut or altered"),
    "two that changed places": (lambda x: x.__setitem__(slice(8, 10), [x[9], x[8]]), False, "removed, added or moved"),
    "all of it gone": (lambda x: x.clear(), False, "it was cut or altered"),
    "one of another case": (lambda x: x[2].update(case="case-" + "0" * 20), False, "another case"),
    "one of the future": (lambda x: x[-1].update(at_ns=2**62), True, "the future"),
    "one without what it needs": (lambda x: x[-1].update(kind="put", payload={}), True, "makes no sense"),
    "one of no kind": (lambda x: x[-1].update(kind="format c:"), True, "could not happen here"),
    "one of nobody's role": (lambda x: x[5].update(role="king"), True, "makes no sense"),
    "one that could not happen": (lambda x: x[-2].update(payload={**x[-2]["payload"], "version": 77}), True,
                                  "could not happen"),
    "one said twice": (lambda x: x[-1].update({k: x[-2][k] for k in ("actor", "client", "number")}), True,
                       "cannot be kept"),
    "a number that is a word": (lambda x: x[-1].update(number="3"), True, "not in order"),
    "words that are a list": (lambda x: x[-1].update(payload=[]), False, "not in order"),
}  # fmt: skip


@pytest.mark.parametrize("what", LOGS)
def test_a_log_that_was_altered_and_signed_anew(
    file: Path, doubtful: Client, untouched: Server, tmp_path: Path, what: str
) -> None:
    change, relink, words = LOGS[what]
    assert words in refused(doubtful, altered(file, tmp_path / "x.zip", in_log(change, relink), sign=True))
    assert not list((untouched.config.data / "files").glob("??/*")), "nothing of it was kept"


# ------------------------------------------------------------------------------------------------------- hostile zips


def test_zips_that_are_made_to_do_harm(untouched: Server, doubtful: Client, tmp_path: Path) -> None:
    def made(name: str, data: bytes = b"x", **info: Any) -> Path:
        with zipfile.ZipFile(tmp_path / "h.zip", "w", zipfile.ZIP_DEFLATED) as z:
            entry = zipfile.ZipInfo(name)
            for k, v in info.items():
                setattr(entry, k, v)
            z.writestr(entry, data)
        return tmp_path / "h.zip"

    for name in ("../out.txt", "/etc/x", "a/../../x", "C:/x", "a\\..\\x", "~/x", "a\x01b"):
        assert "of the name" in refused(doubtful, made(name)), name
    assert "link" in refused(doubtful, made("l", b"/etc/passwd", external_attr=0o120777 << 16))
    with zipfile.ZipFile(tmp_path / "h.zip", "w") as z:
        z.writestr("a", b"1")
        with pytest.warns(UserWarning, match="Duplicate"):
            z.writestr("a", b"2")
    assert "two files of the name" in refused(doubtful, tmp_path / "h.zip")
    for junk in (b"", b"PK\x03\x04", b"no zip at all" * 100, (tmp_path / "h.zip").read_bytes()[:-30]):
        (tmp_path / "j.zip").write_bytes(junk)
        assert "no zip file" in refused(doubtful, tmp_path / "j.zip")
    assert not list(tmp_path.parent.glob("out.txt"))
    assert not list((untouched.config.data / "work").glob("*"))


def test_a_zip_bomb_and_a_bundle_that_is_too_large(tmp_path: Path, file: Path) -> None:
    limits = Limits(upload_bytes=300_000)
    with Server(Config(tmp_path / "small", port=0, limits=limits), fast_passwords=True) as server:
        populate(server)
        with Client(server.url, "operator", PASSWORD) as operator:
            bomb = tmp_path / "bomb.zip"
            with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as z:
                z.writestr("manifest.json", b"0" * 50_000_000)
            assert bomb.stat().st_size < 300_000
            assert "when it is unpacked; at most 300000" in refused(operator, bomb)
            with pytest.raises(HubError) as e:
                operator.import_case(file)
            assert e.value.status == 413
            assert operator.cases().total == 0


# --------------------------------------------------------------------------------------------- scans from elsewhere


def test_a_scan_of_a_time_before_photographs_comes_in(elsewhere: Client, scan_folder: Path, tmp_path: Path) -> None:
    old = Path(shutil.copytree(scan_folder, tmp_path / "old"))
    doc = json.loads((old / "scan.json").read_text())
    for view in doc["views"]:
        view.pop("picture")
    for name in [n for n in doc["files"] if "picture" in n or n.startswith("preview")]:
        (old / name).unlink()
        del doc["files"][name]
    doc.pop("preview", None)
    doc["figures"].pop("specimen", None)
    (old / "scan.json").write_text(json.dumps(doc))
    (old / "mine.txt").write_text("of no concern")
    case = elsewhere.open_case("S20-1")
    job = case.add_scan(old, "from the attic")
    assert job.result is not None
    assert job.result["scan"] == doc["hash"]
    scan = case.scans()[0]
    assert scan.label == "from the attic"
    assert scan.taken_ns // 10**9 == int(__import__("datetime").datetime.fromisoformat(doc["created"]).timestamp())
    names = {f.name for f in scan.files}
    assert "surface.glb" in names
    assert not {n for n in names if n.endswith((".jpg", ".txt"))}
    assert case.state().standing["scan"] == doc["hash"], "the case had none, so strokes can be drawn on it"
    with case.enter() as room:
        room.draw({"id": "s", "camera": "camera1", "pixels": [[50, 50], [90, 60]], "width_mm": 0.8})
        version = room.submit()
    assert version.phase in ("submitted", "draft")
    with zipfile.ZipFile(case.bundle(tmp_path / "b.zip")) as z:
        assert "report.pdf" in z.namelist()
    with pytest.raises(HubError, match="in this case already"):
        case.add_scan(old)


def test_surfaces_come_coarse_to_fine(elsewhere: Client, scan_folder: Path) -> None:
    """Two packed levels beside the plain surface: content-addressed, in ranges, and from the scan that they say."""
    if not export.can_pack():
        pytest.skip("needs fringescope[meshopt]")
    case = elsewhere.open_case("S20-9")
    case.add_scan(scan_folder)
    scan = case.scans()[0]
    files = {f.name: f for f in scan.files}
    plain = export.read_glb(scan_folder / "surface.glb")
    for level, most in ((0, 20_000), (1, 200_000)):
        f = files[f"level-{level}.glb"]
        data = case.fetch(f.sha256)
        assert (hashlib.sha256(data).hexdigest(), len(data), f.type) == (f.sha256, f.size, "model/gltf-binary")
        told = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])["asset"]["extras"]
        assert (told["scan"], told["level"], told["of_triangles"]) == (scan.id, level, plain.n_faces)
        assert told["triangles"] <= min(most, plain.n_faces)
        part = case.hub.http.get(f"/api/cases/{case.id}/files/{f.sha256}", headers={"Range": "bytes=0-99"})
        assert (part.status_code, part.content) == (206, data[:100])
    assert files["level-0.glb"].size <= 700_000
    assert files["level-1.glb"].size < files["surface.glb"].size
    assert case.fetch(files["surface.glb"].sha256) == (scan_folder / "surface.glb").read_bytes()


def test_a_second_scan_from_elsewhere_is_to_look_at_unless_asked(
    elsewhere: Client, scan_folder: Path, tmp_path: Path
) -> None:  # fmt: skip
    case = elsewhere.open_case("S20-2")
    case.add_scan(scan_folder)
    first = case.state().standing["scan"]
    other = Path(shutil.copytree(scan_folder, tmp_path / "other"))
    doc = json.loads((other / "scan.json").read_text())
    for name, more in (("1", None), ("2", True)):
        doc["hash"] = "sha256:" + name * 64
        (other / "scan.json").write_text(json.dumps(doc))
        case.add_scan(other, present=more)
        assert (case.state().standing["scan"] == doc["hash"]) is bool(more)
    assert case.state().scans == [first, "sha256:" + "1" * 64, "sha256:" + "2" * 64]
    assert len(case.scans()) == 3


def test_what_is_no_scan_does_not_come_in(elsewhere: Client, scan_folder: Path, tmp_path: Path) -> None:
    case = elsewhere.open_case("S20-3")
    before = case.get().seq

    def tried(change: Callable[[Path], Any]) -> str:
        folder = tmp_path / "broken"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(scan_folder, folder)
        change(folder)
        with pytest.raises(HubError) as e:
            case.add_scan(folder)
        return str(e.value)

    def doc(**values: Any) -> Callable[[Path], Any]:
        def change(folder: Path) -> None:
            told = json.loads((folder / "scan.json").read_text())
            (folder / "scan.json").write_text(json.dumps({**told, **values}))

        return change

    assert "one folder with its scan.json" in tried(lambda f: (f / "scan.json").unlink())
    assert "missing" in tried(lambda f: (f / "cloud.ply").unlink())
    assert "changed since" in tried(lambda f: (f / "cloud.ply").write_bytes(b"ply"))
    assert "higher than this program reads" in tried(doc(version=9))
    assert 'lists no "files"' in tried(doc(files=[]))
    assert "missing" in tried(doc(files={"../../x": "sha256:0"}))
    assert "sha256:" in tried(doc(hash="../../etc"))
    assert case.get().seq == before
    assert case.scans() == []


# ------------------------------------------------------------------------------------------------- what goes wrong


def left_over(hub: Server) -> list[Path]:
    """What lies in the hub's folder for work, once it had time to tidy up."""
    import time

    end = time.monotonic() + 60
    work = hub.config.data / "work"
    while list(work.glob("*")) and time.monotonic() < end:
        time.sleep(0.02)
    return list(work.glob("*"))


def raw(hub: Server, client: Client, head: str, body: bytes = b"") -> Any:
    """A request by hand, of which the rest never comes."""
    import socket

    port = int(hub.url.rsplit(":", 1)[1])
    made = socket.create_connection(("127.0.0.1", port), timeout=60)
    cookie = f"fringescope={client.http.cookies['fringescope']}"
    lines = f"{head} HTTP/1.1\r\nhost: 127.0.0.1:{port}\r\ncookie: {cookie}\r\nx-csrf-token: {client.me.csrf}\r\n"
    made.sendall(lines.encode() + (f"content-length: {10 * len(body)}\r\n" if body else "").encode() + b"\r\n" + body)
    return made


def test_an_upload_that_breaks_off_leaves_nothing(hub: Server, elsewhere: Client, file: Path) -> None:
    import time

    with raw(hub, elsewhere, "POST /api/cases/import", file.read_bytes()[:200_000]):
        end = time.monotonic() + 60
        while not list((hub.config.data / "work").glob("upload-*")) and time.monotonic() < end:
            time.sleep(0.01)
        assert list((hub.config.data / "work").glob("upload-*"))
    assert not left_over(hub)
    assert elsewhere.cases().total == 0
    assert elsewhere.import_case(file).get().scans == 1, "the hub goes on"


def test_a_download_that_nobody_takes_leaves_nothing(exported: dict[str, Any]) -> None:
    hub = exported["hub"]
    with Client(hub.url, "operator", PASSWORD) as operator:
        made = raw(hub, operator, f"GET /api/cases/{exported['id']}/bundle")
        assert made.recv(20).startswith(b"HTTP/1.1 200")
        made.close()
    assert not left_over(hub)


def test_who_takes_bundles_slowly_does_not_fill_the_disk(exported: dict[str, Any]) -> None:
    hub = exported["hub"]
    path = f"/api/cases/{exported['id']}/bundle"
    taking = hub.site.leaving.taking
    with Client(hub.url, "operator", PASSWORD) as operator:
        taking[operator.me.person.id] = 2  # on their way
        with pytest.raises(HubError, match="you are taking 2 bundles already; wait until one of them has come") as e:
            operator.raw("GET", path)
        assert e.value.status == 429
        taking[operator.me.person.id] = 1
        assert operator.raw("GET", path).content[:2] == b"PK"
        with raw(hub, operator, f"GET {path}") as made:
            assert made.recv(20).startswith(b"HTTP/1.1 200")
        assert not left_over(hub)
        assert taking.total() == 1
        taking.clear()


def test_a_full_disk_is_told_before_anything_is_kept(
    hub: Server, elsewhere: Client, file: Path, scan_folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:  # fmt: skip
    case = elsewhere.import_case(file)
    blobs = len(list((hub.config.data / "files").glob("??/*")))
    monkeypatch.setattr(hub.site.blobs, "free_bytes", lambda: 1000)
    for attempt in (
        lambda: elsewhere.import_case(file),
        lambda: case.bundle(tmp_path / "x.zip"),
        lambda: case.add_scan(scan_folder),
    ):
        with pytest.raises(HubError, match="1000 bytes left") as e:
            attempt()
        assert e.value.status == 507
    assert len(list((hub.config.data / "files").glob("??/*"))) == blobs
    assert not left_over(hub)


def test_a_file_that_was_damaged_on_the_hubs_disk_does_not_leave_unseen(
    hub: Server, elsewhere: Client, file: Path, tmp_path: Path
) -> None:  # fmt: skip
    case = elsewhere.import_case(file)
    cloud = next(f for f in case.scans()[0].files if f.name == "cloud.ply")
    path = hub.site.blobs.path(cloud.sha256)
    path.chmod(0o640)
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.unlink()  # the folder that is laid out shares the content
    path.write_bytes(data)
    with pytest.raises(HubError, match=r"cloud\.ply .* damaged on the hub's disk"):
        case.bundle(tmp_path / "x.zip")
    assert not (tmp_path / "x.zip").exists()
