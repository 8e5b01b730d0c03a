"""A real PostgreSQL server of the tests' own, on a socket in a folder of its own."""

from __future__ import annotations

import itertools
import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psycopg
import pytest

from support.ray_cluster import descendants, kill_all

PROGRAMS = Path("/usr/lib/postgresql")
STARTING_SECONDS = 60.0


class Postgresql:
    """A cluster in a folder; it may be stopped and started again.

    Args:
        programs: folder of ``initdb`` and ``postgres``.
        folder: of the data and the socket.
    """

    def __init__(self, programs: Path, folder: Path) -> None:
        self.folder = folder
        self._programs = programs
        self._user = _owner_of(folder)
        self._names = itertools.count()
        self._server: subprocess.Popen[bytes] | None = None
        command = [programs / "initdb", "-D", folder / "data", "-A", "trust", "-U", "postgres", "-N"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=folder, **self._user)

    @property
    def pid(self) -> int:
        """Of the process that the others of the server are children of."""
        assert self._server is not None
        return self._server.pid

    def start(self) -> None:
        """Start, and wait until it answers."""
        settings = (
            "listen_addresses=",
            f"unix_socket_directories={self.folder}",
            "fsync=off",  # of the machine, which no test takes down
            "max_connections=200",
        )
        command = [self._programs / "postgres", "-D", self.folder / "data"]
        command += itertools.chain.from_iterable(("-c", setting) for setting in settings)
        with open(self.folder / "log", "ab") as log:
            self._server = subprocess.Popen(command, stdout=log, stderr=log, cwd=self.folder, **self._user)
        deadline = time.monotonic() + STARTING_SECONDS
        while not self._answers():
            if self._server.poll() is not None or time.monotonic() > deadline:
                pytest.fail((self.folder / "log").read_text())
            time.sleep(0.05)

    def stop(self) -> None:
        """At once, as in a crash: every connection breaks, and the next start recovers."""
        if self._server is not None:
            self._server.send_signal(signal.SIGQUIT)
            self._server.wait(30)

    def kill(self) -> None:
        """Send SIGKILL to all of its processes at once."""
        if self._server is not None:
            kill_all(descendants(self._server.pid))
            self._server.wait()

    def connect(self, database: str = "postgres") -> psycopg.Connection[Any]:
        return psycopg.connect(host=str(self.folder), user="postgres", dbname=database, autocommit=True)

    def new_database(self, options: str = "") -> str:
        """The address of an empty database."""
        name = f"test_{next(self._names)}"
        with self.connect() as connection:
            connection.execute(f"CREATE DATABASE {name} {options}")  # type: ignore[arg-type]
        return f"postgresql://postgres@/{name}?host={self.folder}"

    def _answers(self) -> bool:
        try:
            self.connect().close()
        except psycopg.OperationalError:
            return False
        return True


@contextmanager
def running_postgresql() -> Iterator[Postgresql]:
    """A running server for the time of the context; the test is skipped where its programs are not installed."""
    programs = sorted(PROGRAMS.glob("*/bin/initdb"), key=lambda path: int(path.parts[4]))
    if not programs:
        pytest.skip("PostgreSQL's programs are not here; install them with: apt install postgresql")
    folder = Path(tempfile.mkdtemp(prefix="surrogym-pg-"))
    try:
        postgresql = Postgresql(programs[-1].parent, folder)
        postgresql.start()
        try:
            yield postgresql
        finally:
            postgresql.stop()
    finally:
        shutil.rmtree(folder)


def _owner_of(folder: Path) -> dict[str, Any]:
    """PostgreSQL refuses root; root runs it as the user Debian made for it."""
    if os.geteuid() != 0:
        return {}
    owner = pwd.getpwnam("postgres")
    os.chown(folder, owner.pw_uid, owner.pw_gid)
    return {"user": owner.pw_uid, "group": owner.pw_gid, "extra_groups": []}
