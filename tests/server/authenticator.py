"""A passkey device in software: ES256, attestation "none", written from the specification and not from the hub.

W3C Web Authentication level 2, sections 6.1 (authenticator data), 6.5 (attestation), 5.8.1 (client data); RFC 8949 for
CBOR, RFC 9053 for the key. Whatever a test wants to be wrong can be given.
"""

from __future__ import annotations

import base64
import hashlib
import json
import secrets
from dataclasses import dataclass, field
from typing import Any

from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec

PRESENT, VERIFIED, ATTESTED = 0x01, 0x04, 0x40


def b64(data: bytes) -> str:
    return base64.urlsafe_b64encode(data).rstrip(b"=").decode()


def unb64(text: str) -> bytes:
    return base64.urlsafe_b64decode(text + "=" * (-len(text) % 4))


def cbor(value: Any) -> bytes:
    """The few kinds of CBOR that an attestation is made of."""

    def head(kind: int, n: int) -> bytes:
        if n < 24:
            return bytes([kind << 5 | n])
        return bytes([kind << 5 | 24, n]) if n < 256 else bytes([kind << 5 | 25]) + n.to_bytes(2, "big")

    if isinstance(value, int):
        return head(0, value) if value >= 0 else head(1, -1 - value)
    if isinstance(value, bytes):
        return head(2, len(value)) + value
    if isinstance(value, str):
        return head(3, len(value.encode())) + value.encode()
    return head(5, len(value)) + b"".join(cbor(k) + cbor(v) for k, v in value.items())


@dataclass
class Authenticator:
    """A device with one key. `counts`: whether it counts its signatures, as old devices do."""

    origin: str
    counts: bool = True
    key: ec.EllipticCurvePrivateKey = field(default_factory=lambda: ec.generate_private_key(ec.SECP256R1()))
    id: bytes = field(default_factory=lambda: secrets.token_bytes(32))
    count: int = 0
    user: str = ""

    def _client_data(self, kind: str, challenge: str, origin: str | None) -> bytes:
        said = {"type": kind, "challenge": challenge, "origin": origin or self.origin, "crossOrigin": False}
        return json.dumps(said).encode()

    def _data(self, rp: str, flags: int) -> bytes:
        self.count += self.counts
        return hashlib.sha256(rp.encode()).digest() + bytes([flags]) + self.count.to_bytes(4, "big")

    def create(
        self, options: dict[str, Any], *, origin: str | None = None, rp: str | None = None,
        challenge: str | None = None, flags: int = PRESENT | VERIFIED, kind: str = "webauthn.create",
    ) -> dict[str, Any]:  # fmt: skip
        """A new key, as navigator.credentials.create() gives it."""
        assert {"type": "public-key", "alg": -7} in options["pubKeyCredParams"]
        assert options["authenticatorSelection"]["userVerification"] == "required"
        self.user = options["user"]["id"]
        p = self.key.public_key().public_numbers()
        cose = cbor({1: 2, 3: -7, -1: 1, -2: p.x.to_bytes(32, "big"), -3: p.y.to_bytes(32, "big")})
        data = self._data(rp or options["rp"]["id"], flags | ATTESTED)
        data += bytes(16) + len(self.id).to_bytes(2, "big") + self.id + cose
        client = self._client_data(kind, challenge or options["challenge"], origin)
        response = {
            "clientDataJSON": b64(client),
            "attestationObject": b64(cbor({"fmt": "none", "attStmt": {}, "authData": data})),
        }
        return {"id": b64(self.id), "rawId": b64(self.id), "type": "public-key", "response": response}

    def get(
        self, options: dict[str, Any], *, origin: str | None = None, rp: str | None = None,
        challenge: str | None = None, flags: int = PRESENT | VERIFIED, kind: str = "webauthn.get",
        user: str | None = None, key: ec.EllipticCurvePrivateKey | None = None,
    ) -> dict[str, Any]:  # fmt: skip
        """A signature, as navigator.credentials.get() gives it."""
        assert options["userVerification"] == "required"
        data = self._data(rp or options["rpId"], flags)
        client = self._client_data(kind, challenge or options["challenge"], origin)
        signed = (key or self.key).sign(data + hashlib.sha256(client).digest(), ec.ECDSA(hashes.SHA256()))
        response = {
            "clientDataJSON": b64(client), "authenticatorData": b64(data), "signature": b64(signed),
            "userHandle": self.user if user is None else user,
        }  # fmt: skip
        return {"id": b64(self.id), "rawId": b64(self.id), "type": "public-key", "response": response}
