"""For scripts: every command takes --json and --quiet, and with both prints one JSON document and not a word more."""

from __future__ import annotations

import json
import uuid
from collections.abc import Iterator
from typing import Any

import pytest

from support.commands import command_line, options
from support.server import ServerProcess

ELSEWHERE = {
    "audit": "tests/training/test_handover.py",
    "conformance": "tests/diagnosis/test_conformance.py",
    "demo": "tests/demo/test_demo.py",
    "deploy": "tests/deployment/test_command.py",
    "describe": "test_describe.py",
    "evaluate": "test_commands.py",
    "export-policy": "tests/policies/test_export.py",
    "policy alias": "test_commands.py",
    "prior": "test_prior.py",
    "watch": "test_watch.py",
    "renew": "test_renew.py",
    "policy delete": "test_commands.py",
    "policy get": "test_commands.py",
    "policy push": "test_commands.py",
    "policy show": "test_commands.py",
    "serve": "tests/server/cli/test_serve.py",
    "train": "test_commands.py",
    "jobs": "test_jobs.py",
    "work": "tests/work",
}
LINES = """
register CartPole-v1 --name NAME --budget 6 --initial 4
sample NAME --max-queries 4
status
status NAME
improve NAME --queries 1
change NAME --pause
export NAME --out samples.csv
delete NAME --yes
doctor
policies pendulum
report pendulum
export pendulum --out pendulum.surrogate
import pendulum.surrogate --name NAME
delete NAME --yes
"""


def all_commands(group: Any = command_line(), before: tuple[str, ...] = ()) -> Iterator[str]:
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from all_commands(command, (*before, name))
        else:
            yield " ".join((*before, name))


@pytest.mark.parametrize("command", list(all_commands()))
def test_every_command_has_the_options_json_and_quiet(command: str) -> None:
    assert {"--json", "--quiet"} <= options(*command.split())


def test_with_json_and_quiet_every_command_prints_only_one_json_document(
    surrogym, pendulum_server: ServerProcess
) -> None:
    name, server, run = f"script-{uuid.uuid4().hex[:8]}", ("--server", pendulum_server.url), set()
    for line in LINES.replace("NAME", name).strip().splitlines():
        words = line.split()
        run.add(words[0])
        said = surrogym(*words, "--json", "--quiet", *server)
        assert (said.code, said.err) == (0, ""), line
        assert isinstance(json.loads(said.out), dict), line
    assert run | ELSEWHERE.keys() == set(all_commands())


@pytest.mark.parametrize(
    ("line", "shown"), [("report pendulum", "report: done"), ("export pendulum -o s.csv", "export: done")]
)
def test_long_commands_show_their_progress(surrogym, pendulum_server: ServerProcess, line, shown) -> None:
    assert shown in surrogym(*line.split(), "--server", pendulum_server.url).err


def test_a_waiting_command_prints_what_it_waits_for(surrogym, pendulum_server: ServerProcess, monkeypatch) -> None:
    monkeypatch.setattr("surrogym_shared.terminal.FIRST_SECONDS", 0.05)
    server = ("--server", pendulum_server.url)
    said = surrogym("sample", "nowhere", "--wait", "0.5", *server)
    assert said.err.startswith("wait: for 'nowhere' to be registered\n")
    assert surrogym("register", "Pendulum-v1", "--wait", "1.1", "--server", "http://127.0.0.1:9").err.startswith(
        "wait: for a server at http://127.0.0.1:9\n"
    )
