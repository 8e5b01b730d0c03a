"""``surrogym serve`` as a process: says where it listens, ends cleanly, and forgets no session when it does."""

from __future__ import annotations

import fcntl
import json
import os
import signal
import subprocess
import sys
import termios
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import httpx
import pytest
import torch

from support import pendulum
from support.server import COLD, STARTING_SECONDS, refusal, running_server, start_server

SERVE = [sys.executable, "-m", "surrogym_server", "serve"]
PATIENCE = 60.0
WITHOUT_CUDA = pytest.mark.skipif(torch.cuda.is_available(), reason="torch has CUDA here")


def test_the_serve_command_refuses_a_database_in_use_in_one_sentence(server_process: Any, tmp_path: Path):
    database = str(server_process.folder / "surrogym.db")
    assert "surrogym.db" in refusal(tmp_path, "--port", "0", "--database", database)


def test_the_serve_command_refuses_a_port_in_use_in_one_sentence(server_process: Any, tmp_path: Path):
    port = server_process.url.rpartition(":")[2]
    assert f"port {port}" in refusal(tmp_path, "--port", port, "--database", str(tmp_path / "other.db"))


@pytest.mark.parametrize(
    ("options", "environment", "said"),
    [
        (["--host", "0.0.0.0"], {}, "host 0.0.0.0 can be reached from other machines: expected a token"),
        (["--port", "70000"], {}, "setting port"),
        (["--token-file", "/no/such/file"], {}, "/no/such/file"),
        ([], {"WEB_CONCURRENCY": "4"}, "expected one server process, got WEB_CONCURRENCY=4"),
        (["--database", "mysql://x/y"], {}, "mysql"),
        (["--ray-hosts", "1"], {}, "--ray-hosts: expected --engine ray with it, got the engine local"),
        (["--ray-address", "auto"], {"SURROGYM_ENGINE": "local"}, "--ray-address: expected --engine ray with it"),
        (["--device", "tpu"], {}, "setting device: expected 'cpu' or 'cuda'"),
        pytest.param([], {"SURROGYM_DEVICE": "cuda"}, "setting device: expected cpu, got cuda", marks=WITHOUT_CUDA),
    ],
)
def test_the_serve_command_refuses_invalid_settings_at_start(
    tmp_path: Path, options: list[str], environment: dict[str, str], said: str
):
    assert said in refusal(tmp_path, *options, **environment)


def test_the_help_of_serve_contains_an_example():
    result = subprocess.run([*SERVE, "--help"], capture_output=True, text=True, timeout=PATIENCE)
    assert result.returncode == 0
    assert "surrogym serve --port" in result.stdout


def test_sessions_continue_after_a_clean_stop_and_restart_of_the_server(tmp_path: Path):
    server = start_server(tmp_path)
    with httpx.Client(base_url=server.url, timeout=60) as client:
        pendulum.teach(client, "p", budget=5)
        sessions = [
            client.post("/v1/surrogates/p/sessions", json={"num_envs": 2, "seed": 0}).json()["id"] for _ in range(2)
        ]
        for session in sessions:
            client.post(f"/v1/sessions/{session}/reset", json={"seq": 1}).raise_for_status()
        step = {"seq": 2, "action": [[0.5], [-0.5]]}
        first = client.post(f"/v1/sessions/{sessions[0]}/step", json=step).content
    assert server.stop() == 0
    assert "Traceback" not in server.log
    assert "SIGTERM: the server stops" in server.log
    assert "sessions saved: 2" in server.log
    with running_server(tmp_path) as again, httpx.Client(base_url=again.url, timeout=60) as client:
        replies = [client.post(f"/v1/sessions/{session}/step", json=step).content for session in sessions]
    assert replies == [first, first], "a repeat of the last step, and the same step made only now"


def test_a_server_that_ignores_sighup_survives_a_closed_terminal(tmp_path: Path):
    """Who starts a server with SIGHUP ignored wants it to stay."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        server = start_server(tmp_path, program=COLD)
    finally:
        signal.signal(signal.SIGHUP, before)
    server.process.send_signal(signal.SIGHUP)
    for _ in range(5):
        assert httpx.get(f"{server.url}/healthz").status_code == 200
        time.sleep(0.1)
    assert server.stop() == 0
    assert "SIGHUP" not in server.log


def test_closing_the_servers_terminal_saves_its_sessions(tmp_path: Path):
    """The kernel hangs up on all its processes, that of the fits too, and nothing can be written any more."""
    ready, database = tmp_path / "ready", tmp_path / "surrogym.db"
    window, terminal = os.openpty()
    with subprocess.Popen(
        [*SERVE, "--port", "0", "--database", str(database), "--ready-file", str(ready), "--quiet"],
        stdin=terminal,
        stdout=terminal,
        stderr=terminal,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    ) as process:
        os.close(terminal)
        try:
            deadline = time.monotonic() + STARTING_SECONDS
            while not ready.exists():
                assert time.monotonic() < deadline
                time.sleep(0.05)
            with httpx.Client(base_url=ready.read_text(), timeout=60) as client:
                pendulum.teach(client, "p", budget=5)
                session = client.post("/v1/surrogates/p/sessions", json={"seed": 0}).raise_for_status().json()["id"]
        finally:
            os.close(window)  # which ends the process
        assert process.wait(PATIENCE) == 0
    with running_server(tmp_path) as again:
        assert httpx.get(f"{again.url}/v1/sessions/{session}").status_code == 200


def test_a_stopping_server_does_not_wait_for_open_event_streams(tmp_path: Path):
    server = start_server(tmp_path)
    with httpx.Client(base_url=server.url, timeout=60) as client:
        client.post("/v1/surrogates", json={"name": "p", "spec": pendulum.spec()}).raise_for_status()
        with client.stream("GET", "/v1/surrogates/p/events") as stream:
            next(stream.iter_lines())
            start = time.monotonic()
            assert server.stop(signal.SIGINT) == 0
    assert "Traceback" not in server.log
    assert time.monotonic() - start < PATIENCE / 2
    assert "timeout graceful shutdown exceeded" not in server.log


def test_a_killed_server_leaves_no_fitting_process_behind(tmp_path: Path):
    server = start_server(tmp_path, program=COLD)
    children = _wait_for_children(server.process.pid)
    server.stop(signal.SIGKILL)
    deadline = time.monotonic() + PATIENCE
    while any(_alive(child) for child in children):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_the_serve_command_prints_its_address_as_json_and_ends_with_its_parent_process(tmp_path: Path):
    ready = tmp_path / "ready"
    options = ["--port", "0", "--database", str(tmp_path / "p.db"), "--ready-file", str(ready), "--json"]
    options.append("--exit-with-parent")
    parent = "import subprocess, sys; print(subprocess.Popen(sys.argv[1:]).pid, flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", parent, *SERVE, *options],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as process:
        assert process.stdout is not None
        server = int(process.stdout.readline())
        deadline = time.monotonic() + PATIENCE
        while not ready.exists():
            assert time.monotonic() < deadline
            time.sleep(0.05)
        process.kill()
        process.wait()
        while _alive(server):
            assert time.monotonic() < deadline + PATIENCE
            time.sleep(0.05)
        assert json.loads(process.stdout.read()) == {"url": ready.read_text(), "version": version("surrogym")}


def _wait_for_children(pid: int) -> list[int]:
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        found = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True)
        if children := [int(line) for line in found.stdout.split()]:
            return children
        time.sleep(0.05)
    raise AssertionError("the server started no process for its fits")


def _alive(pid: int) -> bool:
    """Whether a process runs; one that ended and that nobody waits for does not."""
    state = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True).stdout.strip()
    return bool(state) and not state.startswith("Z")
