"""One who watches by WebRTC: the hub's end of it.

Needs the package aiortc (fringescope[webrtc]). Media flow through the address that the hub is bound to and no other;
no server elsewhere is asked, and nothing is sent to an address that has not called first, with the session's password.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import fractions
import importlib
import json
import logging
import socket
import time
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Any

from fringescope.errors import DeviceError, FormatError, FringescopeError

_TICKS = 90_000  #: a second, on RTP's clock of video
_WIDTH, _QUALITY = 960, 90  #: of the pictures that the encoder gets
_EVERY_S = 1 / 12
_TRIES = 20  #: pictures in a row that may fail
_UNTOLD = 50  #: messages that wait for the data channel to open, which takes longer than the first pictures
_LONGEST = 64_000  #: letters of an offer
_ANY = ("0.0.0.0", "::")
_LOG = logging.getLogger("fringescope.webrtc")

Live = Callable[[str, int, int], Awaitable[dict[str, Any]]]
Seen = Callable[[], Awaitable[tuple[bool, str]]]


def has_webrtc() -> bool:
    """Whether the package is here."""
    try:
        importlib.import_module("aiortc")
    except ImportError:
        return False
    return True


def _without_candidates(sdp: str) -> str:
    """An offer that names no address: who sent it calls us, and is answered where the call came from."""
    kept = [x for x in sdp.splitlines() if not x.startswith(("a=candidate:", "a=end-of-candidates"))]
    return "\r\n".join(kept) + "\r\n"


class Peer:
    """Somebody who watches a camera. `live` takes a picture, `seen` tells whether they still may, and at which scan.

    `ended` is set once it is over: `expelled` if their right has ended, else `why`. Lives on one event loop.
    """

    def __init__(self, live: Live, seen: Seen, camera: str, host: str) -> None:
        self._rtc: Any = importlib.import_module("aiortc")
        self._live, self._seen, self._camera, self._host = live, seen, camera, host
        self._connection = self._rtc.RTCPeerConnection(self._rtc.RTCConfiguration(iceServers=[]))
        self._channel: Any = None
        self.ended, self.expelled, self.why = asyncio.Event(), False, ""
        self._number = self._begun_ns = 0
        self._untold: deque[dict[str, Any]] = deque(maxlen=_UNTOLD)

    async def answer(self, offer: str) -> str:
        """The answer to an offer; media flow once the other side calls. Raises FormatError, DeviceError."""
        if len(offer) > _LONGEST:
            raise FormatError(f"an offer of {len(offer)} letters; at most {_LONGEST} are taken")
        c = self._connection
        c.on("datachannel", self._opened)
        c.on("connectionstatechange", self._changed)
        try:
            video = c.addTransceiver(self._track(), direction="sendonly")
            known = self._rtc.RTCRtpSender.getCapabilities("video").codecs
            video.setCodecPreferences([k for k in known if k.mimeType == "video/VP8"])
            description = self._rtc.RTCSessionDescription(_without_candidates(offer), "offer")
            await c.setRemoteDescription(description)
            found = c.getTransceivers()
            if found != [video] or video.mid is None:
                raise FormatError(f"an offer of {len(found)} media, or no video; needed one video, to be received")
            self._bind(video.sender.transport.transport.iceGatherer)
            made = await c.createAnswer()
            await c.setLocalDescription(made)
        except FringescopeError:
            raise
        except Exception as e:  # of a library that reads what strangers send
            raise FormatError(f"an offer that nobody understands: {type(e).__name__}") from e
        if "a=candidate:" not in c.localDescription.sdp:
            raise DeviceError(f"no way for video at {self._host}; take it as JPEG")
        return str(c.localDescription.sdp)

    def _bind(self, gatherer: Any) -> None:
        """Media on the hub's own address: the library would take all but loopback."""
        if self._host in _ANY:
            return
        found = socket.getaddrinfo(self._host, None, type=socket.SOCK_DGRAM)
        own = list(dict.fromkeys(str(x[4][0]) for x in found))
        ice = gatherer._connection  # noqa: SLF001  # aioice knows no other way to say where
        gather = ice.get_component_candidates

        async def only_here(component: int, addresses: list[str], **more: Any) -> Any:
            del addresses  # those of all adapters
            return await gather(component=component, addresses=own, **more)

        ice.get_component_candidates = only_here

    def _opened(self, channel: Any) -> None:
        if self._channel is None:
            self._channel = channel
            for message in self._untold:
                self._tell(message)
            self._untold.clear()

    def _changed(self) -> None:
        if self._connection.connectionState in ("failed", "closed"):
            self._end("the connection was lost")

    def _end(self, why: str, expelled: bool = False) -> None:
        if not self.ended.is_set():
            self.why, self.expelled = why, expelled
            self.ended.set()

    def _track(self) -> Any:
        peer, rtc = self, self._rtc

        class Sight(rtc.MediaStreamTrack):  # type: ignore[misc, name-defined]
            kind = "video"

            async def recv(self) -> Any:
                return await peer._frame()

        return Sight()

    async def _frame(self) -> Any:
        """The next picture; its scan and time go ahead of it through the data channel."""
        av = importlib.import_module("av")
        for _ in range(_TRIES):
            begun = time.monotonic()
            may, scan = await self._seen()
            if not may:
                self._end("", expelled=True)
            if self.ended.is_set():
                break
            try:
                picture = await self._live(self._camera, _WIDTH, _QUALITY)
            except DeviceError as e:
                self._tell({"type": "refusal", "why": str(e)})
                await asyncio.sleep(1.0)
                continue
            image = await asyncio.to_thread(_decoded, picture["jpeg"])
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            self._begun_ns = self._begun_ns or picture["at_ns"]
            frame.pts = (picture["at_ns"] - self._begun_ns) * _TICKS // 1_000_000_000
            frame.time_base = fractions.Fraction(1, _TICKS)
            self._number += 1
            self._tell({"type": "frame", "number": self._number, "camera": self._camera, "at_ns": picture["at_ns"],
                        "scan": scan, "ticks": frame.pts % 2**32})  # fmt: skip
            await asyncio.sleep(max(0.0, _EVERY_S - (time.monotonic() - begun)))
            return frame
        self._end("the camera gives no picture")
        raise importlib.import_module("aiortc.mediastreams").MediaStreamError

    def _tell(self, message: dict[str, Any]) -> None:
        if self._channel is None:
            self._untold.append(message)
        elif self._channel.readyState == "open":
            with contextlib.suppress(Exception):
                self._channel.send(json.dumps(message))

    async def close(self) -> None:
        """No more video."""
        self._end("closed")
        try:
            await self._connection.close()
        except Exception:  # it is closed in any case
            _LOG.exception("a video connection was not closed in good order")


def _decoded(jpeg: str) -> Any:
    """A picture (h, w, 3) BGR, of even size as the encoder needs it."""
    import cv2
    import numpy as np

    image = cv2.imdecode(np.frombuffer(base64.b64decode(jpeg), np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise DeviceError("the camera's picture cannot be read")
    return np.ascontiguousarray(image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2])
