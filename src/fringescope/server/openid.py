"""People of an identity provider: OpenID Connect, by authorization code with PKCE, state and nonce.

The provider is asked over its own connection; what comes through a browser is only ever a code, and is worth something
only to the browser that began (its cookie), once, and for a few minutes.
"""

from __future__ import annotations

import base64
import hashlib
import secrets
import threading
import time
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote_plus, urlencode, urlsplit

import httpx
from joserfc import jwt
from joserfc.errors import JoseError
from joserfc.jwk import KeySet

from fringescope.errors import FormatError, FringescopeError, UsageError
from fringescope.server.accounts import LONGEST, Accounts, S, SignInError, plain_name
from fringescope.server.challenges import Challenges
from fringescope.server.clock import Clock
from fringescope.server.config import LOOPBACK, Provider
from fringescope.wire import Person, PersonRole

CALLBACK = "/api/provider/callback"
GOOD_S = 600.0  #: how long somebody may take at the provider's page
_FRESH_S = 300.0  #: who proved who they are there so long ago at most has done so now
_LEEWAY_S = 60  #: by which clocks may differ
_KEYS_S = 60.0  #: keys are asked for anew so often at most
_AGAIN_S = 5.0  #: one that did not answer is asked again so often at most: who waits for it keeps others from working
_LONGEST = 1_000_000  #: bytes of an answer
_PATIENCE_S = 10.0  #: within so long it must have come
_ALGORITHMS = ("RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "ES512", "EdDSA")
_WRONG = "the identity provider's answer does not fit; begin again"


class ProviderError(FringescopeError):
    """The identity provider does not answer, or not as it should: a sentence for the screen."""


@dataclass(frozen=True)
class _Begun:
    """Somebody is at the provider's page."""

    browser: str
    nonce: str
    verifier: str


class OpenId:
    """The identity provider of a hub. `origin` is where it sends people back to. May be used from several threads."""

    def __init__(self, provider: Provider, origin: str, clock: Clock, accounts: Accounts) -> None:
        self._provider, self._clock, self._accounts = provider, clock, accounts
        self.redirect = origin + CALLBACK
        self._begun: Challenges[_Begun] = Challenges(clock, GOOD_S)
        self._lock = threading.Lock()
        self._asked_ns = 0
        self._about: dict[str, Any] | None = None
        self._keys: tuple[int, KeySet] | None = None

    def subject(self, sub: str) -> str:
        """How a person of the provider is written in `people.subject`: no two providers can mean the same one."""
        return f"{self._provider.issuer} {sub}"

    def begin(self) -> tuple[str, str]:
        """The provider's page to go to, and a secret for the cookie of the browser that goes. Raises ProviderError."""
        where = str(self._described()["authorization_endpoint"])
        state, browser = secrets.token_urlsafe(32), secrets.token_urlsafe(32)
        begun = _Begun(_hashed(browser), secrets.token_urlsafe(32), secrets.token_urlsafe(48))
        self._begun.give(state, begun)
        query = {
            "response_type": "code", "client_id": self._provider.client, "redirect_uri": self.redirect,
            "scope": self._provider.scope, "state": state, "nonce": begun.nonce,
            "code_challenge": _hashed(begun.verifier), "code_challenge_method": "S256",
        }  # fmt: skip
        return f"{where}{'&' if urlsplit(where).query else '?'}{urlencode(query)}", browser

    def finish(self, state: str, code: str, browser: str, issuer: str | None) -> tuple[Person, bool]:
        """Who came back, and whether they proved just now who they are. Raises SignInError and ProviderError."""
        begun = self._begun.take(state)
        if begun is None or not secrets.compare_digest(begun.browser, _hashed(browser)):
            raise SignInError("this sign-in did not begin in this browser, or took too long; begin again")
        if issuer not in (None, self._provider.issuer):
            raise SignInError(_WRONG)
        claims = self._claims(self._exchange(code, begun.verifier), begun.nonce)
        at = claims.get("auth_time")
        fresh = isinstance(at, int) and 0 <= self._clock.now_ns() / S - at + _LEEWAY_S <= _FRESH_S + _LEEWAY_S
        return self._person(claims), fresh

    # ---------------------------------------------------------------------------------------------------- the provider

    def _described(self) -> dict[str, Any]:
        with self._lock:
            if self._about is None:
                issuer, now = self._provider.issuer, self._clock.now_ns()
                if now - self._asked_ns < _AGAIN_S * S:
                    raise ProviderError("the identity provider does not answer; try again in a few seconds")
                self._asked_ns = now
                about = self._ask("GET", f"{issuer.rstrip('/')}/.well-known/openid-configuration")
                if about.get("issuer") != issuer:
                    raise ProviderError(
                        f"{issuer} calls itself {str(about.get('issuer'))[:100]!r}; correct --oidc-issuer"
                    )
                for name in ("authorization_endpoint", "token_endpoint", "jwks_uri"):
                    parts = urlsplit(str(about.get(name, "")))
                    near = parts.scheme == "http" and parts.hostname in LOOPBACK and issuer.startswith("http://")
                    if parts.scheme != "https" and not near:  # a provider elsewhere has nothing to ask of this machine
                        raise ProviderError(f"{issuer}: its {name} is no https address; it cannot be trusted")
                self._about = about
            return self._about

    def _ask(self, method: str, url: str, **how: Any) -> dict[str, Any]:
        """One question to the provider: no redirects, no long answers."""
        try:
            begun = time.monotonic()
            with httpx.stream(method, url, timeout=5.0, headers={"accept": "application/json"}, **how) as answer:
                body = b""
                for piece in answer.iter_bytes():
                    body += piece
                    if time.monotonic() - begun > _PATIENCE_S:
                        raise ProviderError("the identity provider answers too slowly; try again")
                    if len(body) > _LONGEST:
                        raise ProviderError(f"the identity provider's answer is longer than {_LONGEST} bytes")
            found = httpx.Response(answer.status_code, content=body).json()
        except httpx.HTTPError as e:
            raise ProviderError(f"the identity provider does not answer ({type(e).__name__}); try again") from e
        except ValueError as e:
            raise ProviderError("the identity provider's answer is no JSON; try again") from e
        if answer.status_code != 200 or not isinstance(found, dict):
            raise ProviderError(f"the identity provider said no (status {answer.status_code}); begin again")
        return found

    def _exchange(self, code: str, verifier: str) -> str:
        """The identity token for a code."""
        about, p = self._described(), self._provider
        form = {
            "grant_type": "authorization_code", "code": code, "redirect_uri": self.redirect, "code_verifier": verifier
        }  # fmt: skip
        ways = about.get("token_endpoint_auth_methods_supported", ["client_secret_basic"])
        how: dict[str, Any] = {}
        if "client_secret_basic" in ways:
            how["auth"] = httpx.BasicAuth(quote_plus(p.client), quote_plus(p.secret))
        else:
            form |= {"client_id": p.client, "client_secret": p.secret}
        token = self._ask("POST", str(about["token_endpoint"]), data=form, **how).get("id_token")
        if not isinstance(token, str):
            raise ProviderError("the identity provider sent no id_token; is 'openid' among its scopes?")
        return token

    def _key_set(self, anew: bool) -> KeySet:
        about, now = self._described(), self._clock.now_ns()
        with self._lock:
            if self._keys is None or (anew and now - self._keys[0] > _KEYS_S * S):
                try:
                    found = KeySet.import_key_set(self._ask("GET", str(about["jwks_uri"])))  # type: ignore[arg-type]
                except (JoseError, ValueError, KeyError, TypeError) as e:
                    raise ProviderError("the identity provider's keys cannot be read") from e
                self._keys = (now, found)
            return self._keys[1]

    def _claims(self, token: str, nonce: str) -> dict[str, Any]:
        """What a token says, once its signature and everything that binds it to us was checked."""
        for anew in (False, True):  # it may sign with a new key
            try:
                found = jwt.decode(token, self._key_set(anew), algorithms=_ALGORITHMS)
                break
            except (JoseError, ValueError, KeyError, TypeError) as e:
                if anew:
                    raise SignInError(_WRONG) from e
        claims: dict[str, Any] = found.claims
        rules = jwt.JWTClaimsRegistry(
            now=lambda: self._clock.now_ns() // S, leeway=_LEEWAY_S, iss={"essential": True,
            "value": self._provider.issuer}, sub={"essential": True}, aud={"essential": True,
            "value": self._provider.client}, exp={"essential": True}, iat={"essential": True},
        )  # fmt: skip
        try:
            rules.validate(claims)
        except (JoseError, ValueError, TypeError) as e:
            raise SignInError(_WRONG) from e
        sub, audience, given = claims["sub"], claims["aud"], claims.get("nonce")
        several = isinstance(audience, list) and len(audience) > 1
        ours = claims.get("azp", None if several else self._provider.client) == self._provider.client
        same = isinstance(given, str) and secrets.compare_digest(given.encode(), nonce.encode())
        if not ours or not same or not isinstance(sub, str) or not 0 < len(sub) <= 255 or not sub.isascii():
            raise SignInError(_WRONG)
        return claims

    # ---------------------------------------------------------------------------------------------------------- people

    def _person(self, claims: dict[str, Any]) -> Person:
        """Whose account it is: found by issuer and subject alone, never by a name or an address."""
        subject, role = self.subject(claims["sub"]), self._role(claims)
        known = self._accounts.by_subject(subject)
        if known is not None:
            if self._provider.role_claim is not None:
                if role is None:
                    raise SignInError("the identity provider gives you no role here any more; ask whoever runs it")
                if role is not known.role:
                    known = self._accounts.change(known.id, role=role)
            return known
        if not self._provider.admit or role is None:
            raise SignInError("nobody here knows you yet; ask an administrator of this hub for an account")
        for name in self._names(claims):
            try:
                return self._accounts.add(name, None, role, subject=subject)
            except UsageError:
                found = self._accounts.by_subject(subject)  # of two who come at once, one
                if found is not None:
                    return found
        raise FormatError("no name could be made for the new account; ask an administrator for one")

    def _role(self, claims: dict[str, Any]) -> PersonRole | None:
        """The role that the provider names; where it names none, a fixed one or nothing."""
        p = self._provider
        said = claims.get(p.role_claim, []) if p.role_claim is not None else []
        for one in said if isinstance(said, list) else [said]:
            if isinstance(one, str) and one in [r.value for r in PersonRole]:
                return PersonRole(one)
        return None if p.role is None else PersonRole(p.role)

    def _names(self, claims: dict[str, Any]) -> list[str]:
        """Names for a new account: what the provider says, and where that is taken or no name, with something added."""
        said = next((x for k in ("name", "preferred_username") if isinstance(x := claims.get(k), str)), "")
        try:
            said = plain_name(said)
        except UsageError:
            said = "guest of the provider"
        return [said, f"{said[: LONGEST - 20]} ({_hashed(claims['sub'])[:8]})"]


def _hashed(secret: str) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(secret.encode()).digest()).decode().rstrip("=")
