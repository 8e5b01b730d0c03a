"""The script of front servers in containers, beside a real Ray cluster: it joins, serves, and ends as asked."""

from __future__ import annotations

import os
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import httpx
import pytest

from support.postgresql import running_postgresql
from support.ray_cluster import RayCluster

SCRIPT = Path(__file__).parents[2] / "docker" / "front.sh"
PATIENCE = 240.0

pytestmark = [pytest.mark.postgresql, pytest.mark.timeout(600)]


def begun_for(head: str) -> list[int]:
    """Processes of the script: Ray's are no children of it, but they have its variables."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with suppress(OSError):
                variables = (folder / "environ").read_bytes().split(b"\0")
                if f"RAY_HEAD={head}".encode() in variables:
                    found.append(int(folder.name))
    return found


def test_a_front_server_container_script_joins_the_ray_cluster_serves_and_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_AUTH_MODE", "token")  # as the containers have it
    monkeypatch.setenv("RAY_AUTH_TOKEN", secrets.token_hex(32))
    with running_postgresql() as postgresql, tempfile.TemporaryDirectory(prefix="ray") as short:
        cluster = RayCluster(Path(short), 2)
        cluster.start()
        ready = tmp_path / "ready"
        environment = os.environ | {
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "RAY_HEAD": cluster.address,
            "SURROGYM_DATABASE": postgresql.new_database(),
            "SURROGYM_PORT": "0",
            "SURROGYM_RAY_HOSTS": "1",
        }
        with (tmp_path / "log").open("wb") as log:
            front = subprocess.Popen([SCRIPT, "--ready-file", ready], stdout=log, stderr=log, env=environment)
        try:
            deadline = time.monotonic() + PATIENCE
            while not ready.exists():
                assert front.poll() is None, (tmp_path / "log").read_text()
                assert time.monotonic() < deadline, (tmp_path / "log").read_text()
                time.sleep(0.2)
            assert httpx.get(f"{ready.read_text()}/readyz").status_code == 200
            front.send_signal(signal.SIGTERM)
            assert front.wait(60) == 0, (tmp_path / "log").read_text()
        finally:
            for pid in begun_for(cluster.address):
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            front.wait()
            cluster.kill()
