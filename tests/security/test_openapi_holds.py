"""Schemathesis on every operation: no 5xx, no reply that the OpenAPI does not describe, nothing without a token."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from support.chaos import FULL, SEED, times
from support.server import running_server
from support.teaching import teach
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum

TOKEN = "the-token-of-an-admin"
CONFIG = Path(__file__).with_name("schemathesis.toml")
HOOKS = {"SCHEMATHESIS_HOOKS": str(Path(__file__).with_name("hooks.py"))}
PHASES = "examples,coverage,fuzzing,stateful" if FULL else "fuzzing"
ENDLESS = "/events$"  # a stream of server-sent events, which tests/server/api/test_events.py follows


@pytest.mark.timeout(3_600)
def test_every_reply_to_generated_requests_matches_the_openapi_description(tmp_path: Path):
    command = [sys.executable, "-m", "schemathesis.cli", "--config-file", str(CONFIG), "run"]
    options = {
        "--header": f"Authorization: Bearer {TOKEN}",
        "--checks": "all",
        "--exclude-path-regex": ENDLESS,
        "--phases": PHASES,
        "--max-examples": str(times(short=1, full=100)),
        "--seed": str(SEED),
    }
    with running_server(tmp_path, SURROGYM_TOKEN=TOKEN) as server:
        with Api(server.url, token=TOKEN) as api:
            teach(api, "pendulum", pendulum(), queries=12)
        arguments = [part for option in options.items() for part in option]
        done = subprocess.run(
            [*command, f"{server.url}/openapi.json", *arguments],
            cwd=tmp_path,
            env=os.environ | HOOKS,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert server.process.poll() is None
        assert "Traceback" not in server.log
