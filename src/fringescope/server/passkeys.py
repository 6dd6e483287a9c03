"""Passkeys: a key that never leaves a person's own device signs what the hub asks; there is nothing to steal here."""

from __future__ import annotations

import json
import re
import secrets
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

import sqlalchemy as sa
import webauthn
from webauthn.helpers import base64url_to_bytes, bytes_to_base64url, parse_client_data_json
from webauthn.helpers.exceptions import WebAuthnException
from webauthn.helpers.structs import (
    AuthenticatorSelectionCriteria,
    PublicKeyCredentialDescriptor,
    ResidentKeyRequirement,
    UserVerificationRequirement,
)

from fringescope.errors import UsageError
from fringescope.server import database as db
from fringescope.server.accounts import Accounts, Session, SignInError
from fringescope.server.challenges import Challenges
from fringescope.server.clock import Clock
from fringescope.wire.documents import Passkey

_GOOD_S = 300.0  #: how long a challenge waits
_MOST = 20  #: passkeys of one person
_WRONG = "this passkey does not fit, or it took too long; try again, or sign in by another way"
_NAME = "Fringescope"
_ID = re.compile(r"[A-Za-z0-9_-]{1,1400}")
#: of answers that are no answers
_BROKEN = (WebAuthnException, ValueError, KeyError, TypeError, AttributeError, RecursionError)


@dataclass(frozen=True)
class _Asked:
    """What a challenge is for: on which page, and whose new key where it is one."""

    origin: str
    person: str | None = None

    @property
    def rp(self) -> str:
        return urlsplit(self.origin).hostname or ""


class Passkeys:
    """The passkeys of a hub. `origin` is always the page's, one of the hub's own."""

    def __init__(self, engine: sa.Engine, clock: Clock, accounts: Accounts) -> None:
        self._engine, self._clock, self._accounts = engine, clock, accounts
        self._asked: Challenges[_Asked] = Challenges(clock, _GOOD_S)

    # --------------------------------------------------------------------------------------------------------- new ones

    def offer(self, session: Session, origin: str) -> dict[str, Any]:
        """What a device needs to make a key for somebody who is signed in."""
        asked, challenge = _Asked(origin, session.person.id), secrets.token_bytes(32)
        old = [PublicKeyCredentialDescriptor(base64url_to_bytes(k.id)) for k in self.of(session.person.id)]
        options = webauthn.generate_registration_options(
            rp_id=asked.rp, rp_name=_NAME, user_id=session.person.id.encode(), user_name=session.person.name,
            challenge=challenge, exclude_credentials=old,
            authenticator_selection=AuthenticatorSelectionCriteria(
                resident_key=ResidentKeyRequirement.REQUIRED, user_verification=UserVerificationRequirement.REQUIRED
            ),
        )  # fmt: skip
        self._asked.give(bytes_to_base64url(challenge), asked)
        return _plain(webauthn.options_to_json(options))

    def add(self, session: Session, credential: dict[str, Any], label: str) -> Passkey:
        """Keeps a key that a device made. Raises UsageError."""
        challenge, asked = self._taken(credential)
        if asked is None or asked.person != session.person.id:
            raise UsageError(_WRONG)
        try:
            made = webauthn.verify_registration_response(
                credential=credential, expected_challenge=challenge, expected_rp_id=asked.rp,
                expected_origin=asked.origin, require_user_verification=True,
            )  # fmt: skip
        except _BROKEN as e:
            raise UsageError(_WRONG) from e
        if len(self.of(session.person.id)) >= _MOST:
            raise UsageError(f"{_MOST} passkeys already; remove one first")
        key = Passkey(
            id=bytes_to_base64url(made.credential_id), label=label or "passkey", created_ns=self._clock.now_ns()
        )
        row = key.model_dump() | {
            "person_id": session.person.id, "public_key": made.credential_public_key, "sign_count": made.sign_count
        }  # fmt: skip
        try:
            with db.writing(self._engine) as c:
                c.execute(db.passkeys.insert().values(row))
        except sa.exc.IntegrityError:
            raise UsageError("this passkey is known already; use another") from None
        return key

    def of(self, person: str) -> list[Passkey]:
        """Somebody's keys."""
        k = db.passkeys
        with db.reading(self._engine) as c:
            rows = c.execute(sa.select(k).where(k.c.person_id == person).order_by(k.c.created_ns))
            return [Passkey(id=r.id, label=r.label, created_ns=r.created_ns) for r in rows]

    def remove(self, person: str, key: str) -> bool:
        """Takes a key of somebody's away; whether there was one."""
        k = db.passkeys.c
        with db.writing(self._engine) as c:
            return c.execute(db.passkeys.delete().where(k.id == key, k.person_id == person)).rowcount == 1

    # -------------------------------------------------------------------------------------------------------- coming in

    def ask(self, origin: str) -> dict[str, Any]:
        """What a device needs to sign in; it names nobody, so it tells nobody who has an account."""
        asked, challenge = _Asked(origin), secrets.token_bytes(32)
        options = webauthn.generate_authentication_options(
            rp_id=asked.rp, challenge=challenge, user_verification=UserVerificationRequirement.REQUIRED
        )
        self._asked.give(bytes_to_base64url(challenge), asked)
        return _plain(webauthn.options_to_json(options))

    def check(self, credential: dict[str, Any]) -> str:
        """Who holds the key that signed. Raises SignInError, in the same words whatever is wrong."""
        challenge, asked = self._taken(credential)
        k, key = db.passkeys, credential.get("id")
        if not isinstance(key, str) or not _ID.fullmatch(key):
            raise SignInError(_WRONG)
        with db.reading(self._engine) as c:
            row = c.execute(sa.select(k).where(k.c.id == key)).first()
        if row is None or asked is None or asked.person is not None:
            raise SignInError(_WRONG)
        try:
            found = webauthn.verify_authentication_response(
                credential=credential, expected_challenge=challenge, expected_rp_id=asked.rp,
                expected_origin=asked.origin, credential_public_key=row.public_key,
                credential_current_sign_count=row.sign_count, require_user_verification=True,
            )  # fmt: skip
            handle = credential["response"].get("userHandle")
            whose = row.person_id if handle is None else base64url_to_bytes(handle).decode()
        except _BROKEN as e:
            raise SignInError(_WRONG) from e
        if whose != row.person_id:
            raise SignInError(_WRONG)
        with db.writing(self._engine) as c:  # of two that come at once with the same count, one
            same = k.update().where(k.c.id == key, k.c.sign_count == row.sign_count)
            if c.execute(same.values(sign_count=found.new_sign_count)).rowcount != 1:
                raise SignInError(_WRONG)
        return str(row.person_id)

    def _taken(self, credential: dict[str, Any]) -> tuple[bytes, _Asked | None]:
        """The challenge that an answer says it answers, and what that was for: used up, whatever comes of it."""
        try:
            data = parse_client_data_json(base64url_to_bytes(credential["response"]["clientDataJSON"]))
        except _BROKEN:
            return b"", None
        return data.challenge, self._asked.take(bytes_to_base64url(data.challenge))


def _plain(text: str) -> dict[str, Any]:
    made: dict[str, Any] = json.loads(text)
    return made
