"""Passkeys, by a device in software: the good way, and each way in which an answer can be false."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from cryptography.hazmat.primitives.asymmetric import ec

from fringescope.client import Client, HubError
from fringescope.server import database as db
from fringescope.server.running import Server
from tests.server.authenticator import PRESENT, Authenticator, b64, unb64
from tests.server.conftest import PASSWORD, SignIn
from tests.server.people_scenes import hub_at, later


def page(hub: Server) -> str:
    return f"http://localhost:{hub.config.port}"


def registered(hub: Server, client: Client, **how: Any) -> Authenticator:
    """A device whose key belongs to somebody who is signed in."""
    device = Authenticator(page(hub), **how)
    options = client.ask("POST", "/api/passkeys/new")["options"]
    made = client.ask("POST", "/api/passkeys", {"credential": device.create(options), "label": "my key"})
    assert (made["id"], made["label"]) == (b64(device.id), "my key")
    return device


def asked(client: Client) -> dict[str, Any]:
    options: dict[str, Any] = client.ask("POST", "/api/passkeys/ask")["options"]
    return options


def login(client: Client, credential: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = client.ask("POST", "/api/passkeys/login", {"credential": credential})
    return found


@pytest.mark.parametrize("counts", [True, False])
def test_a_passkey_lets_in(hub: Server, sign_in: SignIn, counts: bool) -> None:
    device = registered(hub, sign_in("expert"), counts=counts)
    for _ in range(3):
        with Client(hub.url) as again:
            options = asked(again)
            assert options.get("allowCredentials", []) == []  # nothing tells a stranger who has a key
            account = login(again, device.get(options))
            assert account["person"]["name"] == "expert"
            assert again.ask("GET", "/api/me")["person"]["name"] == "expert"
    assert [k["id"] for k in sign_in("expert").ask("GET", "/api/passkeys")] == [b64(device.id)]
    assert sign_in("operator").ask("GET", "/api/passkeys") == []


def test_a_page_of_ours_is_what_a_key_is_bound_to(tmp_path: Path) -> None:
    origin = "https://hub.hospital.example"
    with hub_at(tmp_path, origins=(origin,)) as hub, Client(hub.url, "expert", PASSWORD) as expert:
        expert.http.headers["origin"] = origin
        options = expert.ask("POST", "/api/passkeys/new")["options"]
        assert options["rp"]["id"] == "hub.hospital.example"
        device = Authenticator(origin)
        expert.ask("POST", "/api/passkeys", {"credential": device.create(options)})
        with Client(hub.url) as again:
            again.http.headers["origin"] = "https://evil.example"
            with pytest.raises(HubError, match="another site"):
                asked(again)
            again.http.headers["origin"] = origin
            with pytest.raises(HubError, match="does not fit"):  # another page of ours, where it was not asked
                login(again, device.get(asked(again), origin=page(hub)))
            assert login(again, device.get(asked(again)))["person"]["name"] == "expert"


Wrong = Callable[[Authenticator, dict[str, Any]], dict[str, Any]]


def changed(credential: dict[str, Any], **response: Any) -> dict[str, Any]:
    return credential | {"response": credential["response"] | response}


def flipped(text: str) -> str:
    data = bytearray(unb64(text))
    data[-1] ^= 1
    return b64(bytes(data))


WRONG_ANSWERS: dict[str, Wrong] = {
    "another page": lambda d, o: d.get(o, origin="https://evil.example"),
    "another port": lambda d, o: d.get(o, origin=d.origin + "0"),
    "another scheme": lambda d, o: d.get(o, origin=d.origin.replace("http", "https")),
    "signed for another site": lambda d, o: d.get(o, rp="evil.example"),
    "a challenge of its own": lambda d, o: d.get(o, challenge=b64(b"x" * 32)),
    "a part of the challenge": lambda d, o: d.get(o, challenge=o["challenge"][:-4]),
    "no challenge": lambda d, o: d.get(o | {"challenge": ""}),
    "another key": lambda d, o: d.get(o, key=ec.generate_private_key(ec.SECP256R1())),
    "a key that nobody has": lambda d, o: Authenticator(d.origin, user=d.user).get(o),
    "somebody else": lambda d, o: d.get(o, user=b64(b"person-0")),
    "no letters for a person": lambda d, o: d.get(o, user=b64(b"\xff\xfe")),
    "nobody there": lambda d, o: d.get(o, flags=0),
    "somebody whom it does not know": lambda d, o: d.get(o, flags=PRESENT),
    "an answer for a new key": lambda d, o: d.get(o, kind="webauthn.create"),
    "a changed signature": lambda d, o: changed(c := d.get(o), signature=flipped(c["response"]["signature"])),
    "a changed count": lambda d, o: changed(
        c := d.get(o), authenticatorData=flipped(c["response"]["authenticatorData"])
    ),
    "no signature": lambda d, o: changed(d.get(o), signature=""),
    "no data": lambda d, o: changed(d.get(o), authenticatorData=""),
    "a list for a word": lambda d, o: changed(d.get(o), signature=[1, 2]),
    "another id within": lambda d, o: d.get(o) | {"rawId": b64(b"other")},
    "a number for an id": lambda d, o: d.get(o) | {"id": 7},
    "half a letter": lambda d, o: d.get(o) | {"id": "\ud800"},
    "no key at all": lambda d, o: d.get(o) | {"type": "password"},
    "an empty answer": lambda _d, _o: {},
    "an answer of nothing": lambda _d, _o: {"response": None},
    "client data that is no JSON": lambda d, o: changed(d.get(o), clientDataJSON=b64(b"\x00\xff")),
    "client data that is a list": lambda d, o: changed(d.get(o), clientDataJSON=b64(b"[[[]]]")),
    "client data that is deep": lambda d, o: changed(d.get(o), clientDataJSON=b64(b"[" * 100_000)),
}


@pytest.fixture(scope="module")
def steady(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A hub for all the tests that leave it as it was."""
    with hub_at(tmp_path_factory.mktemp("passkeys")) as made:
        yield made


@pytest.mark.parametrize("wrong", WRONG_ANSWERS)
def test_a_false_answer_lets_nobody_in(steady: Server, wrong: str) -> None:
    hub = steady
    with Client(hub.url, "expert", PASSWORD) as expert, Client(hub.url) as stranger:
        device = registered(hub, expert)
        options = asked(stranger)
        body = json.dumps({"credential": WRONG_ANSWERS[wrong](device, options)})
        headers = {"content-type": "application/json"}
        answer = stranger.http.post("/api/passkeys/login", content=body, headers=headers)
        assert answer.status_code in (401, 422), answer.text
        assert "set-cookie" not in answer.headers
        named = not any(w in wrong for w in ("challenge", "client data", "answer of", "empty", "half a letter"))
        if named:  # the challenge is used up by a false answer, too
            with pytest.raises(HubError, match="does not fit"):
                login(stranger, device.get(options))
        login(stranger, device.get(asked(stranger)))  # and a true one is still taken
        expert.ask("DELETE", f"/api/passkeys/{b64(device.id)}")


def test_an_answer_is_good_once(hub: Server, sign_in: SignIn) -> None:
    device = registered(hub, sign_in("expert"), counts=False)
    with Client(hub.url) as stranger:
        credential = device.get(asked(stranger))
        login(stranger, credential)
        with pytest.raises(HubError, match="does not fit"):
            login(stranger, credential)
        with ThreadPoolExecutor(4) as pool:  # of several at once, one
            credential = device.get(asked(stranger))
            body = {"credential": credential}
            tries = [pool.submit(stranger.http.post, "/api/passkeys/login", json=body) for _ in range(4)]
            assert sorted(t.result().status_code for t in tries) == [200, 401, 401, 401]


def test_a_challenge_does_not_wait_for_ever(hub: Server, sign_in: SignIn) -> None:
    device = registered(hub, sign_in("expert"))
    with Client(hub.url) as stranger:
        options = asked(stranger)
        later(hub, 299)
        login(stranger, device.get(options))
        options = asked(stranger)
        later(hub, 301)
        with pytest.raises(HubError, match="does not fit"):
            login(stranger, device.get(options))


def test_a_count_that_goes_back_is_a_copy(hub: Server, sign_in: SignIn) -> None:
    device = registered(hub, sign_in("expert"))
    copy = Authenticator(device.origin, key=device.key, id=device.id, count=device.count, user=device.user)
    with Client(hub.url) as stranger:
        login(stranger, device.get(asked(stranger)))
        for count in (0, device.count - 1):  # what comes is one more: at most the same as was seen
            copy.count = count
            with pytest.raises(HubError, match="does not fit"):
                login(stranger, copy.get(asked(stranger)))
        login(stranger, device.get(asked(stranger)))
        with hub.site.engine.connect() as c:
            assert c.execute(sa.select(db.passkeys.c.sign_count)).scalar_one() == device.count


def test_a_new_key_belongs_to_who_asked_for_it(hub: Server, sign_in: SignIn) -> None:
    expert, operator, device = sign_in("expert"), sign_in("operator"), Authenticator(page(hub))
    for_expert = expert.ask("POST", "/api/passkeys/new")["options"]
    with pytest.raises(HubError, match="does not fit"):
        operator.ask("POST", "/api/passkeys", {"credential": device.create(for_expert)})
    with pytest.raises(HubError, match="does not fit"):  # and it is used up
        expert.ask("POST", "/api/passkeys", {"credential": device.create(for_expert)})
    registered(hub, expert, id=device.id)
    with pytest.raises(HubError, match="known already"):  # nobody takes another's key over
        registered(hub, operator, id=device.id)
    shaped = expert.ask("POST", "/api/passkeys/new")["options"] | {"challenge": asked(expert)["challenge"]}
    credential = Authenticator(page(hub)).create(shaped)
    with pytest.raises(HubError, match="does not fit"):  # a question to sign in is none for a new key
        expert.ask("POST", "/api/passkeys", {"credential": credential})
    other = registered(hub, operator)
    with Client(hub.url) as stranger:
        shaped = asked(stranger) | {"challenge": operator.ask("POST", "/api/passkeys/new")["options"]["challenge"]}
        with pytest.raises(HubError, match="does not fit"):  # nor the other way round
            login(stranger, other.get(shaped))


WRONG_KEYS: dict[str, Wrong] = {
    "another page": lambda d, o: d.create(o, origin="https://evil.example"),
    "another site": lambda d, o: d.create(o, rp="evil.example"),
    "another challenge": lambda d, o: d.create(o, challenge=b64(b"y" * 32)),
    "somebody whom it does not know": lambda d, o: d.create(o, flags=PRESENT),
    "an answer to sign in": lambda d, o: d.create(o, kind="webauthn.get"),
    "no attestation": lambda d, o: changed(d.create(o), attestationObject=b64(b"\xa0")),
    "attestation that is no CBOR": lambda d, o: changed(d.create(o), attestationObject=b64(b"\xff" * 9)),
    "an attestation that goes on and on": lambda d, o: changed(d.create(o), attestationObject=b64(b"\x81" * 50_000)),
    "a map of a length that is not there": lambda d, o: changed(
        d.create(o), attestationObject=b64(b"\xbb" + b"\xff" * 8)
    ),
}


@pytest.mark.parametrize("wrong", WRONG_KEYS)
def test_a_false_key_is_not_kept(steady: Server, wrong: str) -> None:
    with Client(steady.url, "observer", PASSWORD) as person:
        options = person.ask("POST", "/api/passkeys/new")["options"]
        credential = WRONG_KEYS[wrong](Authenticator(page(steady)), options)
        with pytest.raises(HubError, match="does not fit") as e:
            person.ask("POST", "/api/passkeys", {"credential": credential})
        assert e.value.status == 400
        assert person.ask("GET", "/api/passkeys") == []


def test_somebody_else_removes_no_key(hub: Server, sign_in: SignIn) -> None:
    device = registered(hub, sign_in("expert"))
    with pytest.raises(HubError, match="no such passkey"):
        sign_in("admin").ask("DELETE", f"/api/passkeys/{b64(device.id)}")
    sign_in("expert").ask("DELETE", f"/api/passkeys/{b64(device.id)}")
    with Client(hub.url) as stranger, pytest.raises(HubError, match="does not fit"):
        login(stranger, device.get(asked(stranger)))


def test_an_open_page_makes_no_key(hub: Server, sign_in: SignIn) -> None:
    expert = sign_in("expert")
    later(hub, 301)
    with pytest.raises(HubError, match="password once more"):
        expert.ask("POST", "/api/passkeys/new")
    expert.confirm(PASSWORD)
    device = registered(hub, expert)
    later(hub, 301)
    expert.ask("POST", "/api/passkeys/confirm", {"credential": device.get(asked(expert))})  # a key does as well
    expert.ask("POST", "/api/passkeys/new")
    operator = sign_in("operator")
    with pytest.raises(HubError, match="not yours"):
        operator.ask("POST", "/api/passkeys/confirm", {"credential": device.get(asked(operator))})


def test_who_is_disabled_or_got_a_new_password_has_no_way_in_by_a_key(hub: Server, sign_in: SignIn) -> None:
    expert, admin = sign_in("expert"), sign_in("admin")
    person, device = expert.me.person.id, registered(hub, expert)
    with Client(hub.url) as stranger:
        admin.ask("PATCH", f"/api/people/{person}", {"disabled": True})
        with pytest.raises(HubError, match="disabled"):
            login(stranger, device.get(asked(stranger)))
        admin.ask("PATCH", f"/api/people/{person}", {"disabled": False})
        login(stranger, device.get(asked(stranger)))
        again = Client(hub.url, "expert", PASSWORD)
        again.ask("POST", "/api/password", {"old": PASSWORD, "new": PASSWORD + "!"})
        login(stranger, device.get(asked(stranger)))  # their own change keeps their keys
        admin.ask("PATCH", f"/api/people/{person}", {"password": PASSWORD})
        with pytest.raises(HubError, match="does not fit"):  # one that was set for them takes them away
            login(stranger, device.get(asked(stranger)))
        again.close()
