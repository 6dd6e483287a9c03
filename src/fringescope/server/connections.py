"""Connections before anybody knows whose they are: how many there may be, how slow, and how much work they may make.

One event loop serves everybody, and a stop goes through it. So nobody who only opens sockets may fill the list of
open files, hold a request that never ends, or keep the loop busy with frames and chunks that hold nothing.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import time
from collections import Counter
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from fringescope.server.config import LOOPBACK
from fringescope.server.security import counted_as
from fringescope.server.throttle import Bucket

_PIECE = 1 << 14  #: bytes that are looked at before it is asked whether they made too much work
_FREE_S = 2e-8  #: seconds of work that a byte may make: plain data make a tenth of it
_DONE_S = 1e-3  #: and a whole request or message, of which others count how many there are
_WORK_S, _WORK_AT_ONCE_S = 0.02, 0.5  #: work beyond it that one connection may make, a second and at once
_SHUT_S = 30.0  #: who made too much work is not heard for so long, unless they are at this machine
_UNREAD = 1 << 20  #: bytes of answers to pings that may wait for who does not read them
_HEAD_S = 20.0  #: within so long a request must say what it asks for


class Door(socket.socket):
    """A listening socket that takes so many connections, and so many from one address.

    This machine's own are always taken: who stands at the instrument is not locked out by who is far away. Behind a
    proxy all come from one address, so only their number counts.
    """

    def __init__(self, family: int, most: int, each: int, behind_proxy: bool) -> None:
        super().__init__(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
        self._most, self._each, self._one = most, each, behind_proxy
        self._open: Counter[str] = Counter()
        self._shut: dict[str, float] = {}

    @property
    def count(self) -> int:
        """Connections from elsewhere that are open."""
        return self._open.total()

    def accept(self) -> tuple[socket.socket, Any]:
        """The next connection; one too many is closed at once."""
        made, address = super().accept()
        if address[0] in LOOPBACK and not self._one:
            return made, address
        who = counted_as(str(address[0]))
        until = self._shut.get(who, 0.0)
        full = self.count >= self._most or (not self._one and self._open[who] >= self._each)
        if full or until > time.monotonic():
            made.close()
            raise ConnectionAbortedError  # as if the other side had gone: asyncio goes on with the next one
        self._open[who] += 1
        return _Counted(made, self, who), address

    def shut(self, address: str) -> None:
        """Somebody made too much work: nothing is taken from there for a while."""
        if not self._one and address not in LOOPBACK:
            now = time.monotonic()
            self._shut = {k: t for k, t in self._shut.items() if t > now} | {counted_as(address): now + _SHUT_S}

    def gone(self, who: str) -> None:
        """A connection was closed."""
        self._open[who] -= 1
        if self._open[who] <= 0:
            del self._open[who]


class _Counted(socket.socket):
    """One connection, which tells the door when it is closed."""

    def __init__(self, made: socket.socket, door: Door, who: str) -> None:
        super().__init__(made.family, made.type, made.proto, made.detach())
        self.setblocking(False)
        self._door: Door | None = door
        self._who = who

    def close(self) -> None:
        """Closes it, once."""
        door, self._door = self._door, None
        super().close()
        if door is not None:
            door.gone(self._who)


class Effort:
    """How much work the bytes of one connection have made, beyond what so many bytes may."""

    def __init__(self) -> None:
        self._bucket = Bucket(_WORK_S, _WORK_AT_ONCE_S)
        self._done = 0

    def spent(self, seconds: float, size: int, done: int) -> bool:
        """Counts what so many bytes made, with so many whole requests or messages up to now; whether it goes on."""
        new, self._done = done - self._done, done
        return self._bucket.take(max(0.0, seconds - _FREE_S * size - _DONE_S * new))


def _carefully(protocol: Any, take: Any, data: bytes) -> bytes:
    """Hands on what has come, a piece at a time, as long as it makes no more work than it may; what it did not take."""
    for k in range(0, len(data), _PIECE):
        piece, begun = data[k : k + _PIECE], time.thread_time()
        take(piece)
        if protocol.over:
            return data[k + _PIECE :]
        if not protocol.effort.spent(time.thread_time() - begun, len(piece), protocol.done):
            protocol.transport.abort()
            protocol.door.shut(protocol.client[0] if protocol.client else "")
            break
    return b""


class Http(H11Protocol):
    """Requests: each must say within a time what it asks for, and not make too much work."""

    def __init__(self, *args: Any, door: Door, **how: Any) -> None:
        super().__init__(*args, **how)
        self.door, self.effort, self.done = door, Effort(), 0
        self._late: asyncio.TimerHandle | None = None

    @property
    def over(self) -> bool:
        """Whether it takes no more: it is closing, or has become a room."""
        return self.transport.is_closing() or self.transport.get_protocol() is not self

    def connection_made(self, transport: Any) -> None:
        """Begins to wait for the first request."""
        super().connection_made(transport)
        self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        """It is over."""
        self._wait(over=True)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Some of a request."""
        left = _carefully(self, super().data_received, data)
        asked = self.cycle is not None and not self.cycle.response_complete
        self._wait(over=asked or self.over)
        if left and not self.transport.is_closing():
            self.transport.get_protocol().data_received(left)  # type: ignore[attr-defined]

    def send_400_response(self, msg: str) -> None:
        """In the form of all our answers."""
        body = json.dumps({"detail": f"{msg.rstrip('.')}: it is no HTTP, or its head is too long; send a shorter one"})
        fields = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
        head = h11.Response(status_code=400, headers=[*fields, (b"connection", b"close")], reason=b"Bad Request")
        for event in (head, h11.Data(data=body.encode()), h11.EndOfMessage()):
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()

    def on_response_complete(self) -> None:
        """A request was answered."""
        self.done += 1
        super().on_response_complete()

    def _wait(self, over: bool = False) -> None:
        if over and self._late is not None:
            self._late.cancel()
            self._late = None
        elif not over and self._late is None:
            self._late = self.loop.call_later(_HEAD_S, self._hang_up)

    def _hang_up(self) -> None:
        self._late = None
        if self.cycle is None or self.cycle.response_complete:
            self.transport.close()


class WebSocket(WebSocketsSansIOProtocol):
    """Rooms: frames that hold nothing are not taken for ever, and pings only from who reads the answers."""

    def __init__(self, *args: Any, door: Door, **how: Any) -> None:
        super().__init__(*args, **how)
        self.door, self.effort, self.done = door, Effort(), 0

    @property
    def over(self) -> bool:
        """Whether it takes no more."""
        return self.transport.is_closing()

    def data_received(self, data: bytes) -> None:
        """Some frames."""
        _carefully(self, super().data_received, data)

    def send_receive_event_to_app(self) -> None:
        """A message is whole."""
        self.done += 1
        super().send_receive_event_to_app()

    def handle_ping(self) -> None:
        """Answers, if the answers are read."""
        if self.transport.get_write_buffer_size() > _UNREAD:
            self.transport.abort()
            return
        super().handle_ping()


def more_files(wanted: int) -> int:
    """As many open files as this process may have, up to `wanted`; how many it may have."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        most = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        if soft != resource.RLIM_INFINITY and soft < most:
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
        return max(most, soft) if soft != resource.RLIM_INFINITY else wanted
    return 512  # what a Windows program may have
