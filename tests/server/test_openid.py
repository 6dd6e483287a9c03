"""People of an identity provider: the good way, and each way in which its answer, or who brings it, can be false."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlencode, urlsplit

import httpx
import pytest
from cryptography.hazmat.primitives.asymmetric import rsa

from fringescope.client import Client
from fringescope.errors import UsageError
from fringescope.server import openid
from fringescope.server.clock import Clock
from fringescope.server.config import Config, Provider
from fringescope.server.running import Server
from tests.server.conftest import PASSWORD
from tests.server.identity_provider import CLIENT, SECRET, IdentityProvider
from tests.server.people_scenes import asked, hub_at, later

Claims = dict[str, Any]


@pytest.fixture
def provider() -> Iterator[IdentityProvider]:
    with IdentityProvider() as made:
        yield made


@pytest.fixture
def hub(tmp_path: Path, provider: IdentityProvider) -> Iterator[Server]:
    known = Provider(provider.issuer, CLIENT, SECRET, role_claim="roles", admit=True)
    with hub_at(tmp_path, provider=known) as made:
        yield made


def browser(hub: Server) -> httpx.Client:
    return httpx.Client(base_url=hub.url)


def begun(by: httpx.Client) -> str:
    """Where the provider's page is."""
    answer = by.get("/api/provider/begin")
    assert answer.status_code == 303, answer.text
    cookie = answer.headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=lax" in cookie
    return answer.headers["location"]


def back(hub: Server, where: str) -> str:
    """Through the provider's page, to where it sends the browser: path and query."""
    answer = httpx.get(where)
    assert answer.status_code == 302, answer.text
    found = urlsplit(answer.headers["location"])
    assert f"{found.scheme}://{found.netloc}" == f"http://localhost:{hub.config.port}"
    return f"{found.path}?{found.query}"


def come_in(hub: Server, by: httpx.Client) -> httpx.Response:
    return by.get(back(hub, begun(by)))


@pytest.mark.parametrize("name", ["authorization_endpoint", "token_endpoint", "jwks_uri"])
def test_a_provider_elsewhere_has_nothing_to_ask_of_this_machine(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """What it says of itself must not make the hub a messenger to servers that only this machine reaches."""
    issuer = "https://sso.hospital.example"
    good = {n: f"{issuer}/{n}" for n in ("authorization_endpoint", "token_endpoint", "jwks_uri")} | {"issuer": issuer}
    for address in ("http://127.0.0.1:8017/api", "http://localhost/", "file:///etc/passwd", "", "gopher://sso/"):
        there = openid.OpenId(Provider(issuer, CLIENT, SECRET, role="observer"), "https://hub", Clock(), None)  # type: ignore[arg-type]
        monkeypatch.setattr(there, "_ask", lambda *_, a=address: good | {name: a})
        with pytest.raises(openid.ProviderError, match=f"its {name} is no https address"):
            there.begin()


def test_a_provider_that_never_ends_its_answer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A byte now and then keeps a connection, and with it whoever signs in, for ever."""
    monkeypatch.setattr(openid, "_PATIENCE_S", 0.3)
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def trickle() -> None:
            made, _ = listening.accept()
            with made, contextlib.suppress(OSError):
                made.recv(65536)
                made.sendall(b"HTTP/1.1 200 OK\r\ncontent-length: 100000\r\n\r\n")
                for _ in range(600):
                    made.sendall(b" ")
                    time.sleep(0.05)

        threading.Thread(target=trickle, daemon=True).start()
        known = Provider(f"http://127.0.0.1:{listening.getsockname()[1]}", CLIENT, SECRET, role="observer")
        with hub_at(tmp_path, provider=known) as hub, browser(hub) as by:
            answer = by.get("/api/provider/begin")
            assert (answer.status_code, "too slowly" in answer.text) == (503, True)


def test_somebody_of_the_provider_comes_in(hub: Server, provider: IdentityProvider) -> None:
    with browser(hub) as one, browser(hub) as two:
        assert one.get("/api/ways").json()["provider"] == "/api/provider/begin"
        answer = come_in(hub, one)
        assert (answer.status_code, answer.headers["location"]) == (303, "/")
        me = one.get("/api/me").json()["person"]
        assert (me["name"], me["role"]) == ("Dr. Anna Ärztin", "expert")
        provider.claims["name"] = "somebody else now"  # who it is says the subject, never the name
        assert come_in(hub, two).status_code == 303
        assert two.get("/api/me").json()["person"] == me
        assert one.get("/api/me").status_code == 200
    assert provider.asked.count("/realm/keys") == 1


def test_a_name_that_is_taken_takes_nothing_over(hub: Server, provider: IdentityProvider) -> None:
    provider.claims["name"] = "admin"
    with browser(hub) as by:
        assert come_in(hub, by).status_code == 303
        me = by.get("/api/me").json()["person"]
        assert me["name"].startswith("admin (")
        assert me["role"] == "expert"
    provider.sub, provider.claims["name"] = "another", "ad\u200bmin\u202e"  # letters that nobody sees
    with browser(hub) as by:
        assert come_in(hub, by).status_code == 303
        assert by.get("/api/me").json()["person"]["name"].startswith("guest of the provider")
    with Client(hub.url, "admin", PASSWORD) as admin:
        assert admin.me.person.role == "admin"


def test_the_provider_says_the_role(hub: Server, provider: IdentityProvider) -> None:
    with browser(hub) as by:
        come_in(hub, by)
        provider.claims["roles"] = ["astronaut", "observer", "admin"]
        assert by.get("/api/me").json()["person"]["role"] == "expert"
        with browser(hub) as again:
            assert come_in(hub, again).status_code == 303
            assert again.get("/api/me").json()["person"]["role"] == "observer"
        assert by.get("/api/me").status_code == 401  # a right was lost: what was open is closed
        for none in ([], "", None, 7, {"expert": True}, ["Expert"], [["expert"]]):
            provider.claims["roles"] = none
            answer = come_in(hub, by)
            assert (answer.status_code, "no role" in answer.text) == (401, True), none


# ------------------------------------------------------------------------------------------------------- false answers

OTHER = rsa.generate_private_key(65537, 2048)
NOW = time.time
BENT: dict[str, Callable[[Claims], Claims]] = {
    "another nonce": lambda c: c | {"nonce": "n" * 43},
    "no nonce": lambda c: {k: v for k, v in c.items() if k != "nonce"},
    "a nonce that is a number": lambda c: c | {"nonce": 7},
    "for another client": lambda c: c | {"aud": "another"},
    "for nobody": lambda c: {k: v for k, v in c.items() if k != "aud"},
    "for others, too, and not for us first": lambda c: c | {"aud": [CLIENT, "other"], "azp": "other"},
    "for others, too, and nobody says who asked": lambda c: c | {"aud": [CLIENT, "other"]},
    "of another issuer": lambda c: c | {"iss": "https://evil.example"},
    "of no issuer": lambda c: {k: v for k, v in c.items() if k != "iss"},
    "expired": lambda c: c | {"exp": int(NOW()) - 120},
    "never to expire": lambda c: {k: v for k, v in c.items() if k != "exp"},
    "an expiry that is no number": lambda c: c | {"exp": "never"},
    "from tomorrow": lambda c: c | {"iat": int(NOW()) + 86_400},
    "not good yet": lambda c: c | {"nbf": int(NOW()) + 3600},
    "about nobody": lambda c: c | {"sub": ""},
    "about a number": lambda c: c | {"sub": 7},
    "about somebody too long": lambda c: c | {"sub": "x" * 256},
}
SIGNED: dict[str, Callable[[IdentityProvider, Claims], str]] = {
    "by another key": lambda p, c: p.signed(c, OTHER),
    "by another key of another name": lambda p, c: p.signed(c, OTHER, kid="key-9"),
    "by another key that it brings along": lambda p, c: p.signed(c, OTHER, jwk=p.public(OTHER, p.kid)),
    "by nobody": lambda p, c: p.unsigned(c),
    "by nobody, written otherwise": lambda p, c: p.unsigned(c, "nOnE"),
    "by nobody, as if by RSA": lambda p, c: p.unsigned(c, "RS256"),
    "by what everybody knows": lambda p, c: p.by_the_public_key(c),
    "with a critical header that nobody knows": lambda p, c: p.signed(c, crit=["odd"], odd=1),
    "over other words": lambda p, c: _exchanged(p, c),
    "no token": lambda _p, _c: "x",
    "an empty token": lambda _p, _c: "..",
    "a list": lambda p, c: p.signed([c]),  # type: ignore[arg-type]
    "far too deep": lambda p, c: p.signed(c | {"x": json.loads("[" * 900 + "]" * 900)}).replace(".", ".W1tb", 1),
}


def _exchanged(p: IdentityProvider, c: Claims) -> str:
    head, _, signature = p.signed(c).split(".")
    return f"{head}.{p.signed(c | {'sub': 'somebody-else'}).split('.')[1]}.{signature}"


def refused(hub: Server, answer: httpx.Response) -> None:
    assert answer.status_code == 401, answer.text
    assert set(answer.json()) == {"detail"}
    assert "set-cookie" not in answer.headers
    assert len(hub.site.accounts.people()) == 4  # nobody new


def test_a_false_token_lets_nobody_in(hub: Server, provider: IdentityProvider) -> None:
    with browser(hub) as by:
        for name, bent in BENT.items():
            provider.bent = bent
            refused(hub, come_in(hub, by))
            assert by.get("/api/me").status_code == 401, name
        provider.bent = lambda c: c
        for name, sign in SIGNED.items():
            provider.token = lambda c, sign=sign: sign(provider, c)
            refused(hub, come_in(hub, by))
            assert by.get("/api/me").status_code == 401, name
        provider.token = provider.signed
        provider.bent = lambda c: c | {"aud": [CLIENT, "other"], "azp": CLIENT, "exp": int(NOW()) - 20}  # clocks differ
        assert come_in(hub, by).status_code == 303


def test_keys_that_changed_are_asked_for_anew(hub: Server, provider: IdentityProvider) -> None:
    with browser(hub) as by:
        come_in(hub, by)
        provider.key, provider.kid = OTHER, "key-2"
        provider.published = [provider.public(OTHER, "key-2")]
        assert come_in(hub, by).status_code == 401  # but not as often as somebody likes
        later(hub, 61)
        assert come_in(hub, by).status_code == 303


def test_an_answer_is_worth_something_to_who_began_alone(hub: Server) -> None:
    with browser(hub) as victim, browser(hub) as thief:
        path = back(hub, begun(thief))
        refused(hub, victim.get(path))  # signed in as the thief, without knowing (log-in CSRF)
        refused(hub, thief.get(path))  # and the state is used up
        path = back(hub, begun(victim))
        begun(thief)
        refused(hub, thief.get(path))  # a code that was overheard
        where = begun(victim)
        query = parse_qs(urlsplit(back(hub, where)).query)
        for state in ("", "x", query["state"][0] + "x", query["state"][0][:-1]):
            refused(hub, victim.get("/api/provider/callback?" + urlencode({"code": query["code"][0], "state": state})))
        own = parse_qs(urlsplit(where).query)["state"][0]
        mixed = {"code": query["code"][0], "state": own, "iss": "https://evil.example"}
        refused(hub, victim.get("/api/provider/callback?" + urlencode(mixed)))
        assert victim.get("/api/provider/callback?error=access_denied&state=" + own).status_code == 401
        path = back(hub, begun(victim))
        assert victim.get(path).status_code == 303
        refused_again = victim.get(path)
        assert refused_again.status_code == 401


def test_the_code_of_one_is_no_good_with_the_state_of_another(hub: Server) -> None:
    """PKCE: the provider gives a token for a code to who began with it alone."""
    with browser(hub) as one, browser(hub) as two:
        mine = parse_qs(urlsplit(back(hub, begun(one))).query)
        theirs = parse_qs(urlsplit(back(hub, begun(two))).query)
        mixed = {"code": theirs["code"][0], "state": mine["state"][0]}
        answer = one.get("/api/provider/callback?" + urlencode(mixed))
        assert (answer.status_code, "said no" in answer.text) == (503, True)
        assert len(hub.site.accounts.people()) == 4


def test_it_does_not_wait_for_ever(hub: Server) -> None:
    with browser(hub) as by:
        path = back(hub, begun(by))
        later(hub, 601)
        refused(hub, by.get(path))


def test_who_came_in_before_is_out_when_they_come_in_anew(hub: Server) -> None:
    """No session outlives the next one of the same browser, and none is kept that somebody else chose (fixation)."""
    with browser(hub) as by:
        by.cookies.set("fringescope", "chosen-by-a-thief", domain="127.0.0.1")
        come_in(hub, by)
        first = [c.value for c in by.cookies.jar if c.name == "fringescope"]
        assert "chosen-by-a-thief" not in first[-1:]
        secret = next(c.value for c in by.cookies.jar if c.name == "fringescope" and c.value != "chosen-by-a-thief")
        by.cookies.clear()
        by.cookies.set("fringescope", str(secret), domain="127.0.0.1")
        come_in(hub, by)
        with browser(hub) as old:
            old.cookies.set("fringescope", str(secret), domain="127.0.0.1")
            assert old.get("/api/me").status_code == 401


@pytest.mark.parametrize(
    "about",
    [
        {"issuer": "https://evil.example"},
        {"token_endpoint": "http://evil.example/token"},
        {"jwks_uri": None},
        {"authorization_endpoint": "javascript:alert(1)"},
    ],
)
def test_a_provider_that_describes_itself_falsely(hub: Server, provider: IdentityProvider, about: Claims) -> None:
    provider.about = about
    with browser(hub) as by:
        for _ in range(3):
            assert by.get("/api/provider/begin").status_code == 503
        assert len(provider.asked) == 1  # one that does not work is not asked with each click
        provider.about = {}
        later(hub, 6)
        assert come_in(hub, by).status_code == 303


def test_a_provider_that_is_not_there(tmp_path: Path) -> None:
    with IdentityProvider() as gone:
        known = Provider(gone.issuer, CLIENT, SECRET, role="observer")
    with hub_at(tmp_path, provider=known) as hub, browser(hub) as by:
        answer = by.get("/api/provider/begin")
        assert (answer.status_code, "does not answer" in answer.text) == (503, True)
        with Client(hub.url, "expert", PASSWORD):
            pass  # everybody else comes in


def test_who_is_not_admitted_needs_an_account_by_their_subject(tmp_path: Path, provider: IdentityProvider) -> None:
    known = Provider(provider.issuer, CLIENT, SECRET, role="observer")
    with hub_at(tmp_path, provider=known) as hub, browser(hub) as by, Client(hub.url, "admin", PASSWORD) as admin:
        answer = come_in(hub, by)
        assert (answer.status_code, "nobody here knows you" in answer.text) == (401, True)
        new = {"name": "anna", "role": "operator", "subject": provider.sub}
        assert asked(admin, "POST", "/api/people", new).status_code == 201
        assert asked(admin, "POST", "/api/people", new | {"name": "otto"}).status_code == 400
        assert asked(admin, "POST", "/api/people", {"name": "otto", "role": "expert"}).status_code == 400
        assert come_in(hub, by).status_code == 303
        me = by.get("/api/me").json()
        assert (me["person"]["name"], me["person"]["role"]) == ("anna", "operator")
        with Client(hub.url) as nobody:  # no password opens it
            for password in ("", "x", PASSWORD):
                body = {"name": "anna", "password": password}
                assert asked(nobody, "POST", "/api/login", body).status_code in (401, 422)
        admin.ask("PATCH", f"/api/people/{me['person']['id']}", {"disabled": True})
        assert come_in(hub, by).status_code == 401


def test_who_was_signed_in_there_long_ago_has_not_proved_now_who_they_are(
    hub: Server, provider: IdentityProvider
) -> None:
    for bent, fresh in (
        (lambda c: c, True),
        (lambda c: c | {"auth_time": int(NOW()) - 4000}, False),
        (lambda c: c | {"auth_time": int(NOW()) + 4000}, False),
        (lambda c: {k: v for k, v in c.items() if k != "auth_time"}, False),
    ):
        provider.bent = bent
        with browser(hub) as by:
            come_in(hub, by)
            token = {"x-csrf-token": by.get("/api/me").json()["csrf"]}
            assert by.post("/api/passkeys/new", headers=token).status_code == (200 if fresh else 403)


@pytest.mark.parametrize(
    ("how", "why"),
    [
        ({"issuer": "http://sso.hospital.example"}, "https"),
        ({"issuer": "file:///etc/passwd"}, "https"),
        ({"client": ""}, "--oidc-client"),
        ({"secret": ""}, "secret"),
        ({"role": "admin"}, "operator, expert or observer"),
        ({"role": None, "admit": True}, "--oidc-role"),
    ],
)
def test_a_provider_that_is_set_up_wrongly(how: Claims, why: str) -> None:
    good = {"issuer": "https://sso.hospital.example", "client": CLIENT, "secret": SECRET, "role": "observer"}
    with pytest.raises(UsageError, match=why) as e:
        Provider(**(good | how))
    assert "\n" not in str(e.value)
    assert SECRET not in repr(Provider(**good))


def test_where_people_come_back_to_is_never_what_a_request_says(tmp_path: Path, provider: IdentityProvider) -> None:
    known = Provider(provider.issuer, CLIENT, SECRET, role="observer")
    with pytest.raises(UsageError, match="--origin"):
        Config(tmp_path, "0.0.0.0", certificate=tmp_path, key=tmp_path, provider=known)
    with hub_at(tmp_path, provider=known, origins=("https://hub.hospital.example",)) as hub, browser(hub) as by:
        evil = {"host": "evil.example", "x-forwarded-host": "evil.example", "x-forwarded-proto": "http"}
        where = by.get("/api/provider/begin", headers=evil).headers["location"]
        wanted = "https://hub.hospital.example/api/provider/callback"
        assert parse_qs(urlsplit(where).query)["redirect_uri"] == [wanted]
