"""An identity provider on loopback, from the specification (OpenID Connect Core 1.0, RFC 7636) and not from the hub.

It checks what a good one checks: client, secret, redirect, code once, PKCE. What a test wants to be wrong about its
token can be given.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import secrets
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Self
from urllib.parse import parse_qs, urlencode, urlsplit

from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import padding, rsa

CLIENT, SECRET = "fringescope hub", "s3cret: with/odd=letters%"


def b64(data: bytes) -> str:
    return base64.urlsafe_b64encode(data).rstrip(b"=").decode()


def _json(value: Any) -> str:
    return b64(json.dumps(value).encode())


class IdentityProvider:
    """One that knows one person, `sub`, with `claims`; `bent` changes the claims of a token before it is signed."""

    def __init__(self) -> None:
        self.key, self.kid = rsa.generate_private_key(65537, 2048), "key-1"
        self.sub, self.claims = "248289761001", dict[str, Any](name="Dr. Anna Ärztin", roles=["expert"])
        self.bent: Callable[[dict[str, Any]], dict[str, Any]] = lambda claims: claims
        self.token: Callable[[dict[str, Any]], str] = self.signed
        self.published: list[dict[str, Any]] = [self.public(self.key, self.kid)]
        self.about: dict[str, Any] = {}
        self.asked: list[str] = []
        self.codes: dict[str, dict[str, str]] = {}
        provider = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                provider.asked.append(urlsplit(self.path).path)
                self.answer(*provider.get(self.path))

            def do_POST(self) -> None:
                provider.asked.append(urlsplit(self.path).path)
                form = self.rfile.read(int(self.headers["content-length"])).decode()
                self.answer(*provider.exchange(form, self.headers.get("authorization", "")))

            def answer(self, status: int, body: dict[str, Any], where: str = "") -> None:
                data = json.dumps(body).encode()
                self.send_response(status)
                if where:
                    self.send_header("location", where)
                self.send_header("content-length", str(len(data)))
                self.end_headers()
                self.wfile.write(data)

            def log_message(self, *_: Any) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.issuer = f"http://127.0.0.1:{self._server.server_port}/realm"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(5)

    # -------------------------------------------------------------------------------------------------------- its side

    def get(self, path: str) -> tuple[int, dict[str, Any], str]:
        at, query = urlsplit(path).path, {k: v[0] for k, v in parse_qs(urlsplit(path).query).items()}
        if at == "/realm/.well-known/openid-configuration":
            known = {
                "issuer": self.issuer, "authorization_endpoint": f"{self.issuer}/authorize",
                "token_endpoint": f"{self.issuer}/token", "jwks_uri": f"{self.issuer}/keys",
            }  # fmt: skip
            return 200, known | self.about, ""
        if at == "/realm/keys":
            return 200, {"keys": self.published}, ""
        if at == "/realm/authorize":
            assert (query["response_type"], query["client_id"]) == ("code", CLIENT)
            assert "openid" in query["scope"].split()
            assert query["code_challenge_method"] == "S256"
            code = secrets.token_urlsafe(16)
            self.codes[code] = query
            back = urlencode({"code": code, "state": query["state"]})
            return 302, {}, f"{query['redirect_uri']}?{back}"
        return 404, {}, ""

    def exchange(self, body: str, authorization: str) -> tuple[int, dict[str, Any]]:
        form = {k: v[0] for k, v in parse_qs(body).items()}
        who = base64.b64decode(authorization.removeprefix("Basic ")).decode()
        client, secret = (parse_qs(f"x={part}")["x"][0] for part in who.split(":"))
        began = self.codes.pop(form.get("code", ""), None)
        verifier = b64(hashlib.sha256(form.get("code_verifier", "").encode()).digest())
        good = began is not None and (client, secret) == (CLIENT, SECRET) and form["grant_type"] == "authorization_code"
        if not good or began is None or began["code_challenge"] != verifier:
            return 400, {"error": "invalid_grant"}
        if began["redirect_uri"] != form["redirect_uri"]:
            return 400, {"error": "invalid_grant"}
        now = int(time.time())
        claims = {
            "iss": self.issuer, "sub": self.sub, "aud": CLIENT, "iat": now, "exp": now + 300, "auth_time": now,
            "nonce": began["nonce"], **self.claims,
        }  # fmt: skip
        return 200, {"access_token": "x", "token_type": "Bearer", "id_token": self.token(self.bent(claims))}

    # ---------------------------------------------------------------------------------------------------------- tokens

    @staticmethod
    def public(key: rsa.RSAPrivateKey, kid: str) -> dict[str, Any]:
        n = key.public_key().public_numbers()
        size = (n.n.bit_length() + 7) // 8
        return {"kty": "RSA", "use": "sig", "alg": "RS256", "kid": kid, "e": b64(n.e.to_bytes(3, "big")),
                "n": b64(n.n.to_bytes(size, "big"))}  # fmt: skip

    def signed(self, claims: dict[str, Any], key: rsa.RSAPrivateKey | None = None, **header: Any) -> str:
        head = {"alg": "RS256", "kid": self.kid, "typ": "JWT"} | header
        text = f"{_json(head)}.{_json(claims)}"
        return f"{text}.{b64((key or self.key).sign(text.encode(), padding.PKCS1v15(), hashes.SHA256()))}"

    def unsigned(self, claims: dict[str, Any], alg: str = "none") -> str:
        return f"{_json({'alg': alg, 'kid': self.kid})}.{_json(claims)}."

    def by_the_public_key(self, claims: dict[str, Any]) -> str:
        """HS256 with what everybody knows as its secret: a hub that takes the header's word would believe it."""
        pem = self.key.public_key().public_bytes(
            serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
        )
        text = f"{_json({'alg': 'HS256', 'kid': self.kid})}.{_json(claims)}"
        return f"{text}.{b64(hmac.new(pem, text.encode(), hashlib.sha256).digest())}"
