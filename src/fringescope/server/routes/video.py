"""Live video: as JPEG with acknowledgement, which passes every proxy, and as WebRTC for narrow lines."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import time

from fastapi import APIRouter, WebSocket, WebSocketDisconnect
from starlette.concurrency import run_in_threadpool

from fringescope.errors import DeviceError, FormatError, FringescopeError
from fringescope.server.asking import Asking, still
from fringescope.server.rooms import EXPELLED
from fringescope.server.routes.room import enter, refused, turn_away
from fringescope.server.site import Site
from fringescope.server.webrtc import Peer, has_webrtc

router = APIRouter()
_LATE_ACKS = 100  #: other words than the acknowledgement that are passed over
QUALITIES = ((640, 50), (960, 60), (1280, 70), (1920, 80))  #: widths and JPEG qualities, from a poor line to a good one


def _full(site: Site, person: str) -> str:
    """Why somebody may not watch one camera more, in a sentence; "" where they may."""
    limits, watching = site.config.limits, site.instrument.watching
    if watching[person] >= limits.videos_each:
        return f"you watch {watching[person]} streams already; close one; try again later"
    return "too many watch already; try again later" if watching.total() >= limits.videos else ""


@router.websocket("/api/cases/{case}/video/{camera}")
async def video(socket: WebSocket, case: str, camera: str) -> None:
    """What a camera sees: a line of JSON about a frame, the frame as JPEG, and the next once that was acknowledged.

    Each frame carries the scan that the case stands at, and its time. Width and quality follow from how long it takes
    until a frame is acknowledged.
    """
    asking = await enter(socket, case, "video")
    if asking is None:
        return
    site, person = asking.site, asking.speaker.person
    if why := _full(site, person):
        await turn_away(socket, 1013, why)
        return
    site.instrument.watching[person] += 1
    try:
        await socket.accept()
        await _film(socket, asking, case, camera)
    finally:
        site.instrument.watching[person] -= 1


async def _film(socket: WebSocket, asking: Asking, case: str, camera: str) -> None:
    """One frame after the other, as long as they are acknowledged and the person may see them."""
    site = asking.site
    level, number = 1, 0
    try:
        while await run_in_threadpool(still, asking, case):
            width, quality = QUALITIES[level]
            try:
                frame = await site.instrument.live(camera, width, quality)
            except DeviceError as e:
                await socket.send_text(refused(str(e)))
                await asyncio.sleep(1.0)
                continue
            now, _ = await site.hub.truth_of(case)
            data = base64.b64decode(frame["jpeg"])
            number += 1
            told = {"type": "frame", "number": number, "camera": camera, "at_ns": frame["at_ns"],
                    "scan": now.exam.scan, "bytes": len(data), "width": width, "quality": quality}  # fmt: skip
            begun = time.monotonic()
            await socket.send_text(json.dumps(told))
            await socket.send_bytes(data)
            async with asyncio.timeout(30):
                for _ in range(_LATE_ACKS):
                    answer = json.loads(await socket.receive_text())
                    if isinstance(answer, dict) and answer.get("ack") == number:
                        break
                else:
                    raise ValueError("nothing but other words")
            took = 1000 * (time.monotonic() - begun)
            level = max(0, level - 1) if took > 250 else min(len(QUALITIES) - 1, level + 1) if took < 60 else level
        await socket.close(*EXPELLED)
    except (WebSocketDisconnect, TimeoutError, ValueError, KeyError, RuntimeError):  # KeyError: bytes, no text
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):
            await socket.close(1000)


@router.websocket("/api/cases/{case}/webrtc/{camera}")
async def webrtc(socket: WebSocket, case: str, camera: str) -> None:
    """What a camera sees as WebRTC: {"type": "offer", "sdp"} from the page, {"type": "answer", "sdp"} back.

    The offer asks to receive one video and has a data channel, on which each frame's scan and time travel. This
    connection is the leash: when either end closes it, or the right to see the case ends, the video ends.
    """
    asking = await enter(socket, case, "video")
    if asking is None:
        return
    site, person = asking.site, asking.speaker.person
    if (why := _full(site, person)) or site.instrument.peers >= site.config.limits.peers:
        why = why or "too many watch already; try again later, or take the video as JPEG"
        await turn_away(socket, 1013, why)
        return
    site.instrument.watching[person] += 1
    site.instrument.peers += 1
    peer: Peer | None = None
    try:
        await socket.accept()
        await site.instrument.open()
        if not has_webrtc():
            raise DeviceError("this hub was installed without WebRTC (fringescope[webrtc]); take the video as JPEG")
        message = json.loads(await asyncio.wait_for(socket.receive_text(), 30))
        if not isinstance(message, dict) or message.get("type") != "offer" or not isinstance(message.get("sdp"), str):
            raise FormatError('the first message; needed {"type": "offer", "sdp": ..}')

        async def seen() -> tuple[bool, str]:
            if not await run_in_threadpool(still, asking, case):
                return False, ""
            now, _ = await site.hub.truth_of(case)
            return True, now.exam.scan

        peer = Peer(site.instrument.live, seen, camera, site.config.host)
        await socket.send_text(json.dumps({"type": "answer", "sdp": await peer.answer(message["sdp"])}))
        listening = asyncio.create_task(_until_closed(socket))
        ended = asyncio.create_task(peer.ended.wait())
        try:
            await asyncio.wait({listening, ended}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            listening.cancel()
            ended.cancel()
        if peer.ended.is_set():
            await socket.close(*(EXPELLED if peer.expelled else (1000, peer.why[:120])))
    except FringescopeError as e:
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):
            await socket.send_text(refused(str(e)))
            await socket.close(1000)
    except (WebSocketDisconnect, TimeoutError, ValueError, RuntimeError, KeyError):
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):
            await socket.close(1000)
    finally:
        site.instrument.watching[person] -= 1
        site.instrument.peers -= 1
        if peer is not None:
            await peer.close()


async def _until_closed(socket: WebSocket) -> None:
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        while (await socket.receive())["type"] != "websocket.disconnect":
            pass
