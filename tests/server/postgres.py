"""A PostgreSQL server of the tests' own: in a temporary folder, on a socket in it, gone when they end."""

from __future__ import annotations

import itertools
import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import pytest


def programs() -> Path | None:
    """The folder with `initdb` and `postgres`, of the newest version that is installed."""
    if found := shutil.which("initdb"):
        return Path(found).resolve().parent
    places = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), key=lambda p: int(p.parts[-3].split(".")[0]))
    return places[-1].parent if places else None


class Cluster:
    """A server that runs; `new` makes an empty database and returns its URL. Root starts it as the user `postgres`."""

    def __init__(self, options: Sequence[str] = ("fsync=off",)) -> None:
        bin_ = programs()
        if bin_ is None:
            pytest.skip("no PostgreSQL here (tools/system_packages.sh installs it)")
        self._psycopg = pytest.importorskip("psycopg", reason="needs fringescope[postgres]")
        self._as: list[str] = []
        who = next((p for p in pwd.getpwall() if p.pw_name == "postgres"), None)
        if os.getuid() == 0 and who is None:
            pytest.skip("no user `postgres`, as whom root could start PostgreSQL")
        self.folder = Path(tempfile.mkdtemp(prefix="fringescope-pg-"))
        if os.getuid() == 0 and who is not None:
            os.chown(self.folder, who.pw_uid, who.pw_gid)
            self._as = ["setpriv", f"--reuid={who.pw_uid}", f"--regid={who.pw_gid}", "--clear-groups"]
        data = self.folder / "data"
        made = [*self._as, str(bin_ / "initdb"), "-D", str(data), "-U", "hub", "-A", "trust", "-E", "UTF8", "-N",
                "--locale=C"]  # fmt: skip
        subprocess.run(made, check=True, capture_output=True, cwd=self.folder)
        self._numbers = itertools.count(1)
        set_ = ["listen_addresses=", f"unix_socket_directories={self.folder}", "max_connections=120", *options]
        self._command = [*self._as, str(bin_ / "postgres"), "-D", str(data), *(x for o in set_ for x in ("-c", o))]
        self.start()

    def start(self) -> None:
        with (self.folder / "log").open("ab") as log:
            self.process = subprocess.Popen(self._command, stdout=log, stderr=log, cwd=self.folder)
        end = time.monotonic() + 30
        while True:
            try:
                self._psycopg.connect(self.dsn("postgres")).close()
                return
            except self._psycopg.OperationalError:
                if self.process.poll() is not None or time.monotonic() > end:
                    raise
                time.sleep(0.05)

    def dsn(self, name: str) -> str:
        return f"postgresql://hub@/{name}?host={self.folder}"

    def new(self) -> str:
        name = f"hub{next(self._numbers)}"
        with self._psycopg.connect(self.dsn("postgres"), autocommit=True) as c:
            c.execute(f"CREATE DATABASE {name}")
        return self.dsn(name)

    def stop(self) -> None:
        self.process.send_signal(signal.SIGINT)  # ends sessions, then itself
        self.process.wait(30)

    def close(self) -> None:
        self.stop()
        shutil.rmtree(self.folder, ignore_errors=True)
