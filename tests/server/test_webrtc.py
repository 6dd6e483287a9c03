"""Video by WebRTC over loopback, seen by a peer of aiortc's own: who may, what comes with each frame, and its end."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import socket
import time
from collections.abc import AsyncIterator, Coroutine, Iterator
from contextlib import asynccontextmanager
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("aiortc", reason="needs fringescope[webrtc]")

import aiortc
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from fringescope.client import Client, HubCase
from fringescope.server.config import Config, Limits
from fringescope.server.running import Server
from tests.server.conftest import DEVICE, PASSWORD, populate
from tests.server.people_scenes import cookies
from tests.server.test_hub import SCAN, scanned

pytestmark = pytest.mark.timeout(120)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    config = Config(tmp_path_factory.mktemp("bench") / "hub", port=0, instrument=DEVICE, limits=Limits(peers=2))
    with Server(config, fast_passwords=True) as server:
        populate(server)
        yield server


@pytest.fixture(scope="module")
def case(bench: Server) -> Iterator[HubCase]:
    with Client(bench.url, "operator", PASSWORD, timeout_s=60) as operator:
        yield scanned(bench, operator)


@pytest.fixture(autouse=True)
def only_loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    """The peer of these tests stays on this machine, too."""
    from aioice import ice

    monkeypatch.setattr(ice, "get_host_addresses", lambda **_: ["127.0.0.1"])


@pytest.fixture
def guest(bench: Server, case: HubCase) -> Iterator[tuple[Client, str]]:
    """Somebody who was invited to the case, and the invitation."""
    made = case.invite("a guest")
    with Client(bench.url) as client:
        client.accept(made.token or "", made.code or "")
        yield client, made.id


@pytest.fixture
def elsewhere() -> Iterator[socket.socket]:
    """An address of somebody who has nothing to do with it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.bind(("127.0.0.1", 0))
        made.setblocking(False)
        yield made


def address(client: Client, case: str, camera: str = "camera1") -> str:
    return f"{client.url.replace('http', 'ws', 1)}/api/cases/{case}/webrtc/{camera}"


class Watcher:
    """A peer that watches: its connection, what came through the channel, and the track."""

    def __init__(self, door: Any, pc: Any) -> None:
        self.door, self.pc = door, pc
        self.told: list[dict[str, Any]] = []
        self.track: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        self.answer: dict[str, Any] = {}

    async def frames(self, n: int) -> list[Any]:
        track = await asyncio.wait_for(self.track, 30)
        return [await asyncio.wait_for(track.recv(), 30) for _ in range(n)]


@asynccontextmanager
async def watching(client: Client, case: str, more: str = "", camera: str = "camera1") -> AsyncIterator[Watcher]:
    """Asks for the video of a camera; `more` is added to the offer."""
    pc = aiortc.RTCPeerConnection(aiortc.RTCConfiguration(iceServers=[]))
    try:
        async with connect(address(client, case, camera), additional_headers={"Cookie": cookies(client)}) as door:
            w = Watcher(door, pc)
            pc.addTransceiver("video", direction="recvonly")
            pc.createDataChannel("frames").on("message", lambda m: w.told.append(json.loads(m)))
            pc.on("track", w.track.set_result)
            await pc.setLocalDescription(await pc.createOffer())
            await door.send(json.dumps({"type": "offer", "sdp": pc.localDescription.sdp + more}))
            w.answer = json.loads(await asyncio.wait_for(door.recv(), 30))
            if w.answer["type"] == "answer":
                await pc.setRemoteDescription(aiortc.RTCSessionDescription(w.answer["sdp"], "answer"))
            yield w
    finally:
        await pc.close()


async def closed(door: Any) -> tuple[int, str]:
    """With what code and reason a connection is closed; what comes before is passed over."""
    with contextlib.suppress(ConnectionClosed):
        while True:
            await asyncio.wait_for(door.recv(), 20)
    assert door.close_code is not None, "closed without a word"
    return door.close_code, door.close_reason


def between(told: list[dict[str, Any]]) -> set[int]:
    """How far any two frames are apart, by what the channel tells of them, and a tick (11 us) of rounding."""
    ticks = [m["ticks"] for m in told]
    return {(b - a + off) % 2**32 for a in ticks for b in ticks for off in (-1, 0, 1)}


def run(work: Coroutine[Any, Any, Any]) -> Any:
    return asyncio.run(asyncio.wait_for(work, 100))


def test_a_peer_receives_frames_with_their_scan_and_time(
    bench: Server, case: HubCase, elsewhere: socket.socket
) -> None:  # fmt: skip
    named = f"a=candidate:1 1 udp 2130706431 127.0.0.1 {elsewhere.getsockname()[1]} typ host\r\n"

    async def scene() -> None:
        begun = time.time_ns()
        async with watching(case.hub, case.id, named) as w:
            frames = await w.frames(4)
            later = {(f.pts - frames[0].pts) % 2**32 for f in frames[1:]}
            while not later <= between(w.told):  # each frame has its message
                await asyncio.sleep(0.02)
            addresses = {x.split()[4] for x in w.answer["sdp"].splitlines() if x.startswith("a=candidate:")}
            assert addresses == {"127.0.0.1"}
            assert "VP8" in w.answer["sdp"]
            assert "H264" not in w.answer["sdp"]
            numbers = [m["number"] for m in w.told]
            assert numbers == sorted(set(numbers))
            for m in w.told:
                assert (m["type"], m["scan"], m["camera"]) == ("frame", SCAN, "camera1")
                assert begun <= m["at_ns"] <= time.time_ns()
        assert bench.loop is not None
        still = asyncio.run_coroutine_threadsafe(bench.site.instrument.live("camera1", 960, 90), bench.loop).result(30)
        wanted = cv2.imdecode(np.frombuffer(base64.b64decode(still["jpeg"]), np.uint8), cv2.IMREAD_GRAYSCALE)
        assert wanted is not None
        seen = cv2.cvtColor(frames[-1].to_ndarray(format="bgr24"), cv2.COLOR_BGR2GRAY)
        assert abs(seen.shape[0] - wanted.shape[0]) <= 1
        rows, columns = seen.shape
        alike = np.corrcoef(seen.ravel(), wanted[:rows, :columns].ravel())[0, 1]
        assert alike > 0.9, "another picture than the camera's"
        turned = np.corrcoef(seen.ravel(), wanted[:rows, :columns][::-1, ::-1].ravel())[0, 1]
        assert turned < alike

    run(scene())
    with pytest.raises(BlockingIOError):
        elsewhere.recv(1)  # the hub has sent nothing to an address that did not call


def test_who_may_not_see_is_not_answered(bench: Server, case: HubCase) -> None:
    async def tried(client: Client, of: str) -> int:
        headers = {"Cookie": cookies(client)}
        async with connect(address(client, of), additional_headers=headers) as door:
            return (await closed(door))[0]

    other = case.hub.open_case("S26-2")
    with Client(bench.url) as nobody, Client(bench.url, "expert", PASSWORD) as expert:
        assert run(tried(nobody, case.id)) == 4401
        assert run(tried(expert, other.id)) == 4404
    with Client(bench.url, "admin", PASSWORD) as admin:
        assert run(tried(admin, case.id)) == 4403


def test_who_was_revoked_sees_no_more(case: HubCase, guest: tuple[Client, str]) -> None:
    client, invitation = guest

    async def scene() -> None:
        async with watching(client, case.id) as w:
            await w.frames(2)
            await asyncio.to_thread(case.revoke, invitation)
            assert (await closed(w.door))[0] == 4403
            with contextlib.suppress(aiortc.mediastreams.MediaStreamError, TimeoutError):
                for _ in range(1000):  # what was on its way, then the end
                    await asyncio.wait_for((await w.track).recv(), 1)
                raise AssertionError("the video goes on")
            last = len(w.told)
            await asyncio.sleep(0.5)
            assert len(w.told) == last

    run(scene())


def test_offers_that_make_no_sense(bench: Server, case: HubCase) -> None:
    async def said(text: str) -> str:
        async with connect(address(case.hub, case.id), additional_headers={"Cookie": cookies(case.hub)}) as door:
            await door.send(text)
            answer: dict[str, str] = json.loads(await asyncio.wait_for(door.recv(), 20))
            assert answer["type"] == "refusal"
            await closed(door)
            return answer["why"]

    async def audio() -> str:
        pc = aiortc.RTCPeerConnection(aiortc.RTCConfiguration(iceServers=[]))
        pc.addTransceiver("audio", direction="recvonly")
        await pc.setLocalDescription(await pc.createOffer())
        sdp = pc.localDescription.sdp
        await pc.close()
        return str(sdp)

    async def scene() -> None:
        assert "needed" in await said("[]")
        assert "needed" in await said('{"type": "offer", "sdp": 5}')
        assert "nobody understands" in await said(json.dumps({"type": "offer", "sdp": "m=video\r\nv=x"}))
        assert "at most" in await said(json.dumps({"type": "offer", "sdp": "x" * 100_000}))
        assert "needed one video" in await said(json.dumps({"type": "offer", "sdp": await audio()}))

    run(scene())
    end = time.monotonic() + 10
    while bench.site.instrument.watching.total() and time.monotonic() < end:
        time.sleep(0.02)
    assert (bench.site.instrument.watching.total(), bench.site.instrument.peers) == (0, 0)


def test_only_so_many_are_encoded_for(case: HubCase) -> None:
    async def scene() -> None:
        async with watching(case.hub, case.id) as a, watching(case.hub, case.id, camera="camera2") as b:
            await a.frames(1)
            await b.frames(1)
            async with connect(address(case.hub, case.id), additional_headers={"Cookie": cookies(case.hub)}) as door:
                code, why = await closed(door)
                assert (code, "JPEG" in why) == (1013, True)

    run(scene())


def test_a_hub_without_the_package_says_so(case: HubCase, monkeypatch: pytest.MonkeyPatch) -> None:
    from fringescope.server.routes import video

    async def scene() -> None:
        async with connect(address(case.hub, case.id), additional_headers={"Cookie": cookies(case.hub)}) as door:
            assert "take the video as JPEG" in json.loads(await asyncio.wait_for(door.recv(), 60))["why"]

    monkeypatch.setattr(video, "has_webrtc", lambda: False)
    run(scene())
