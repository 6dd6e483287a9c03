"""All parts of a running hub, put together once."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import argon2

from fringescope.errors import OutputError
from fringescope.server import database as db
from fringescope.server import journal
from fringescope.server.accounts import Accounts
from fringescope.server.blobs import Blobs
from fringescope.server.checkpoints import Checkpoints
from fringescope.server.clock import Clock
from fringescope.server.config import Config
from fringescope.server.hub import Hub
from fringescope.server.instrument import Instrument
from fringescope.server.invitations import Invitations
from fringescope.server.jobs import Jobs
from fringescope.server.lab import Lab
from fringescope.server.leaving import Leaving, finish_erasures
from fringescope.server.openid import OpenId
from fringescope.server.passkeys import Passkeys
from fringescope.server.processes.parent import Child
from fringescope.server.rooms import Rooms
from fringescope.server.shelf import Shelf
from fringescope.server.throttle import Throttle


@dataclass(eq=False)
class Site:
    """The parts; `app.state.site` holds them."""

    config: Config
    engine: Any
    clock: Clock
    blobs: Blobs
    accounts: Accounts
    invitations: Invitations
    rooms: Rooms
    hub: Hub
    jobs: Jobs
    instrument: Instrument
    lab: Lab
    requests: Throttle
    logins: Throttle
    ops: Throttle
    written: Throttle
    passkeys: Passkeys
    provider: OpenId | None
    checkpoints: Checkpoints
    leaving: Leaving
    lock: int
    held: db.Held | None
    end: Callable[[], None] = lambda: None  #: ends the hub: whoever serves it says how

    def close(self) -> None:
        """Lets go of the data folder and the database."""
        if self.held is not None:
            self.held.let_go()
        self.engine.dispose()
        os.close(self.lock)


def hold(config: Config) -> int:
    """Takes hold of the data folder: one hub at a time. Raises OutputError if another has it, or it cannot be made."""
    try:
        config.data.mkdir(parents=True, exist_ok=True)
        config.data.chmod(0o700)
        number = os.open(config.data / "hub.lock", os.O_RDWR | os.O_CREAT, 0o600)
    except OSError as e:
        raise OutputError(f"{config.data}: {e.strerror}; needed a folder that can be written") from e
    try:
        import fcntl

        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except ImportError:
        pass  # where there is no such lock, the database's own has to do
    except OSError:
        os.close(number)
        raise OutputError(f"{config.data}: another hub runs on this folder; stop it first") from None
    return number


def open_site(config: Config, hasher: argon2.PasswordHasher | None = None) -> Site:
    """Opens the data of a hub and brings it to the present version. Raises OutputError and FormatError."""
    lock = hold(config)
    with contextlib.ExitStack() as undo:
        undo.callback(os.close, lock)
        shutil.rmtree(config.data / "work", ignore_errors=True)  # of a hub that was killed
        engine = db.open_engine(config.url)
        undo.callback(engine.dispose)
        held = db.hold(engine)
        if held is not None:
            undo.callback(held.let_go)
        db.migrate(engine)
        shutil.rmtree(config.data / "work", ignore_errors=True)  # of a hub that was killed
        clock = Clock(journal.last_ns(engine))
        blobs = Blobs(config.data / "files")
        finish_erasures(config.data, engine, blobs)
        limits = config.limits
        accounts = Accounts(engine, clock, limits, hasher)
        rooms = Rooms(limits.waiting, limits.waiting_letters)
        hub = Hub(engine, clock, accounts, rooms, config.settings.examination)
        jobs = Jobs(engine, clock)
        checkpoints = Checkpoints(engine, clock, config.data)
        accounts.gone = rooms.expel
        shelf, workshop = Shelf(config.data, engine, blobs, config.rig), Child("fringescope.server.processes.workshop")
        instrument = Instrument(hub, blobs, shelf, workshop, config)
        packer = Child("fringescope.server.processes.packer")
        lab = Lab(hub, blobs, shelf, instrument, workshop, packer, config)
        site = Site(
            config, engine, clock, blobs, accounts, Invitations(engine, clock, accounts), rooms, hub, jobs,
            instrument, lab, Throttle(limits.requests_per_s, limits.requests_burst),
            Throttle(limits.logins_per_minute / 60, limits.logins_per_minute),
            Throttle(limits.ops_per_s, limits.ops_burst),
            Throttle(limits.log_bytes_per_s, limits.log_bytes_burst), Passkeys(engine, clock, accounts),
            None if config.provider is None else OpenId(config.provider, config.origin, clock, accounts), checkpoints,
            Leaving(config, hub, blobs, accounts, jobs, instrument, lab, checkpoints, packer), lock, held,
        )  # fmt: skip
        undo.pop_all()
    return site
