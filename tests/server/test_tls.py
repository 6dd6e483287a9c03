"""TLS: with a certificate of its own, and what is not served without."""

from __future__ import annotations

import os
import ssl
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec

from fringescope import cli
from fringescope.client import Client, HubError
from fringescope.errors import UsageError
from fringescope.server import running
from fringescope.server.config import Config
from fringescope.server.running import Server
from tests.server.conftest import PASSWORD, populate
from tests.server.people_scenes import closed, heard, room_of
from tests.server.test_hub import scanned


@pytest.fixture(scope="module")
def hub(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("tls")
    certificate, key = running.self_signed(folder / "hub" / "tls", "127.0.0.1")
    with Server(Config(folder / "hub", port=0, certificate=certificate, key=key), fast_passwords=True) as made:
        populate(made)
        yield made


def test_it_serves_https_and_wss(hub: Server) -> None:
    assert hub.url.startswith("https://")
    with Client(hub.url, "operator", PASSWORD, verify=str(hub.config.certificate)) as operator:
        assert operator.me.local
        case = scanned(hub, operator)
        with case.enter() as room:
            room.comment("by wss")
            assert room.events[-1].kind == "comment"
    with pytest.raises(HubError, match=r"(?i)certificate"):
        Client(hub.url, "operator", PASSWORD)  # nobody believes a certificate that was not handed over
    with pytest.raises(httpx.HTTPError):
        httpx.get(hub.url.replace("https", "http") + "/api/health")


def test_its_cookie_is_secure(hub: Server) -> None:
    with httpx.Client(base_url=hub.url, verify=ssl.create_default_context(cafile=str(hub.config.certificate))) as http:
        answer = http.post("/api/login", json={"name": "expert", "password": PASSWORD})
        name, *flags = [x.strip() for x in answer.headers["set-cookie"].split(";")]
        assert name.startswith("__Host-fringescope=")  # browsers take it over https alone, from this host alone
        assert {"httponly", "samesite=strict", "path=/", "secure"} <= {f.lower() for f in flags}
        assert not [f for f in flags if f.lower().startswith("domain")]
        assert answer.headers["strict-transport-security"].startswith("max-age=")
        secret = name.split("=", 1)[1]
        http.cookies.clear()  # a cookie that a page over http could have set is none
        assert http.get("/api/me", headers={"cookie": f"fringescope={secret}"}).status_code == 401
        assert http.get("/api/me", headers={"cookie": f"__Host-fringescope={secret}"}).status_code == 200


def test_a_page_that_it_serves_itself_is_its_own(hub: Server) -> None:
    """Under TLS the name in the address bar is proved, so a page of that name is ours; under http it is not."""
    context = ssl.create_default_context(cafile=str(hub.config.certificate))
    host = f"localhost:{hub.config.port}"
    with Client(hub.url, "operator", PASSWORD, verify=str(hub.config.certificate)) as operator:
        case = scanned(hub, operator)

        def enter(origin: str, said: list[object]) -> None:
            with room_of(operator, case.id, ssl=context, Origin=origin, Host="localhost") as room:
                said.append("welcome" if origin == f"https://{host}" and heard(room, "welcome") else closed(room)[0])

        for origin, told in ((f"https://{host}", "welcome"), (f"http://{host}", 4403), ("https://localhost", 4403)):
            said: list[object] = []
            for _ in range(3):  # a handshake that a busy machine delays for ten seconds hangs in the client for good
                tried = threading.Thread(target=enter, args=(origin, said), daemon=True)
                tried.start()
                tried.join(25)
                if said:
                    break
            assert said[:1] == [told], origin


def test_a_passkey_is_bound_to_a_page_that_was_named(hub: Server) -> None:
    """A relay at another name can claim that name in Host and Origin; no key is ever made or asked for it."""
    context = ssl.create_default_context(cafile=str(hub.config.certificate))
    with httpx.Client(base_url=hub.url, verify=context) as http:
        evil = f"relay.example:{hub.config.port}"
        answer = http.post("/api/passkeys/ask", headers={"host": evil, "origin": f"https://{evil}"})
        assert (answer.status_code, "--origin" in answer.text) == (409, True)
        mine = http.post("/api/passkeys/ask", headers={"origin": f"https://localhost:{hub.config.port}"})
        assert mine.json()["options"]["rpId"] == "localhost"


def test_the_certificate_is_for_this_machine_and_kept(tmp_path: Path) -> None:
    certificate, key = running.self_signed(tmp_path / "tls", "192.0.2.7")
    made = x509.load_pem_x509_certificate(certificate.read_bytes())
    names = made.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert "192.0.2.7" in {str(i) for i in names.get_values_for_type(x509.IPAddress)}
    assert "localhost" in names.get_values_for_type(x509.DNSName)
    assert made.extensions.get_extension_for_class(x509.BasicConstraints).value.ca is False
    before = certificate.read_bytes(), key.read_bytes()
    assert running.self_signed(tmp_path / "tls", "192.0.2.7") == (certificate, key)
    assert (certificate.read_bytes(), key.read_bytes()) == before
    running.self_signed(tmp_path / "tls", "192.0.2.8")  # another address: made anew
    assert certificate.read_bytes() != before[0]


def broken(what: str, certificate: Path, key: Path) -> None:
    if what == "another key":
        pem, plain = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
        other = ec.generate_private_key(ec.SECP256R1())
        key.write_bytes(other.private_bytes(pem, plain, serialization.NoEncryption()))
    elif what == "no key":
        key.write_bytes(b"")
    else:
        certificate.write_bytes(b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n")


@pytest.mark.parametrize("what", ["another key", "no key", "no certificate"])
def test_files_that_do_not_belong_together_are_made_anew(tmp_path: Path, what: str) -> None:
    certificate, key = running.self_signed(tmp_path, "127.0.0.1")
    broken(what, certificate, key)
    running.self_signed(tmp_path, "127.0.0.1")
    ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key)


def test_the_key_is_its_owner_s_from_its_first_byte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    modes: list[tuple[str, int]] = []
    fdopen = os.fdopen

    def watched(number: int, *how: Any) -> Any:
        mode, size = os.fstat(number).st_mode & 0o777, os.fstat(number).st_size
        assert size == 0
        modes.append((Path(f"/proc/self/fd/{number}").readlink().name, mode))
        return fdopen(number, *how)

    monkeypatch.setattr("fringescope.server.running.os.fdopen", watched)
    folder = tmp_path / "tls"
    folder.mkdir()
    (folder / "key.pem").write_text("somebody left a file that all may read")
    (folder / "key.pem").chmod(0o666)
    (folder / "key.new").write_text("and another")
    (folder / "key.new").chmod(0o666)
    old = os.umask(0)
    try:
        _, key = running.self_signed(folder, "127.0.0.1")
    finally:
        os.umask(old)
    assert modes[0] == ("key.new", 0o600)
    assert key.stat().st_mode & 0o777 == 0o600
    assert b"PRIVATE KEY" in key.read_bytes()
    key.chmod(0o644)
    running.self_signed(folder, "127.0.0.1")  # kept, and closed again
    assert key.stat().st_mode & 0o777 == 0o600


# ------------------------------------------------------------------------------------------------- what is not served


def served(*arguments: str, env: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "fringescope", "serve", "--port", "0", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, env=os.environ | (env or {}))


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["--host", "0.0.0.0"], "others could listen in"),
        (["--host", "0.0.0.0", "--self-signed"], "nobody has an account yet"),
        (["--certificate", "x.pem"], "belong together"),
    ],
)
def test_it_refuses_what_is_not_safe(tmp_path: Path, arguments: list[str], why: str) -> None:
    done = served("--data", str(tmp_path / "hub"), *arguments)
    assert done.returncode == 2, done.stderr
    assert why in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert "Traceback" not in done.stderr
    assert "listens" not in done.stdout + done.stderr


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.7", "hub.hospital.example", "127.0.0.2", ""])
def test_no_other_address_without_tls(tmp_path: Path, host: str) -> None:
    with pytest.raises(UsageError, match="could listen in") as e:
        Config(tmp_path, host)
    assert "\n" not in str(e.value)


def test_other_addresses_need_an_account(tmp_path: Path) -> None:
    certificate, key = running.self_signed(tmp_path / "tls", "127.0.0.2")
    server = Server(Config(tmp_path / "hub", "127.0.0.2", 0, certificate=certificate, key=key), fast_passwords=True)
    try:
        with pytest.raises(UsageError, match="nobody has an account"):
            server.check()
        populate(server)
        server.check()
        with server, Client(server.url, "operator", PASSWORD, verify=str(certificate)) as operator:
            assert operator.instrument().uri == ""
    finally:
        server.close()


def refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    monkeypatch.setattr(sys, "argv", ["fringescope", "serve", *arguments])
    with pytest.raises(SystemExit) as e:
        cli.main()
    assert e.value.code == 2
    said = capsys.readouterr().err.strip()
    assert len(said.splitlines()) == 1
    return said


def test_a_provider_on_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: list[Config] = []

    class Caught:
        def __init__(self, config: Config) -> None:
            seen.append(config)
            raise UsageError("enough")

    monkeypatch.setattr(running, "Server", Caught)
    secret = tmp_path / "secret"
    secret.write_text("s3cret\n")
    base = ["--data", str(tmp_path / "hub"), "--oidc-issuer", "https://sso.hospital.example", "--oidc-client", "hub"]
    assert refused(monkeypatch, capsys, *base, "--oidc-secret", str(secret), "--oidc-role", "observer").endswith(
        "enough"
    )
    assert seen[0].provider is not None
    assert (seen[0].provider.secret, seen[0].provider.role, seen[0].provider.admit) == ("s3cret", "observer", False)
    monkeypatch.setenv("FRINGESCOPE_OIDC_SECRET", "from outside")
    refused(monkeypatch, capsys, *base, "--oidc-role-claim", "roles", "--oidc-admit")
    assert seen[1].provider is not None
    assert (seen[1].provider.secret, seen[1].provider.role_claim, seen[1].provider.admit) == (
        "from outside",
        "roles",
        True,
    )
    assert "s3cret" not in repr(seen[0])
    assert "needed a text file" in refused(monkeypatch, capsys, *base, "--oidc-secret", str(tmp_path / "none"))
    monkeypatch.delenv("FRINGESCOPE_OIDC_SECRET")
    assert "FRINGESCOPE_OIDC_SECRET" in refused(monkeypatch, capsys, *base)
    assert len(seen) == 2
