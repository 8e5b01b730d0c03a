"""Status: what is shown, for people and for programs, once or until Ctrl-C."""

from __future__ import annotations

import json
import re
import subprocess
import sys

import numpy as np
import pytest

from support.dirty import learned
from support.scripted_server import lost_reply, reply, scripted_server
from support.terminal import on_terminal
from surrogym.cli.commands import status
from surrogym_client.transport import Api
from surrogym_shared import wire
from surrogym_shared.dirt import Rollout, identify, sensors
from surrogym_shared.dirt.words import traits

EMPTY = reply(wire.SurrogateList(surrogates=[]).model_dump_json())


@pytest.fixture
def looks(monkeypatch):
    """Ctrl-C is pressed after so many looks."""

    def press_after(count: int) -> None:
        left = iter(range(count - 1))

        def sleep(_: float) -> None:
            if next(left, None) is None:
                raise KeyboardInterrupt

        monkeypatch.setattr("surrogym_shared.terminal.time.sleep", sleep)

    return press_after


def test_the_status_command_with_quiet_prints_name_and_phase(on_server, name):
    on_server("register", "Pendulum-v1", "--name", name)
    assert on_server("status", name, "--quiet").out == f"{name} collecting\n"
    assert f"{name} collecting" in on_server("status", "--quiet").out.splitlines()


def test_the_status_list_shows_used_budget_and_pending_queries(on_server, server_process, name):
    on_server("register", "Pendulum-v1", "--name", name, "--budget", "8", "--initial", "4")
    (line,) = (line for line in on_server("status").out.splitlines() if line.startswith(name))
    assert "0 of 8" in line
    assert "4 pending, 0 leased" in line
    (summary,) = (s for s in on_server("status", "--json").json["surrogates"] if s["name"] == name)
    assert (summary["budget"], summary["target"], summary["queries"]["pending"]) == (8, 0.999, 4)


def test_the_status_list_and_the_status_of_one_count_real_steps_alike(on_server, server_process, name):
    on_server("register", "Pendulum-v1", "--name", name, "--budget", "8", "--initial", "4")
    on_server("sample", name, "--max-queries", "4", "--time-limit", "60")
    with Api(server_process.url) as api:
        api.report_steps(name, 200, episodes=1, note="1 episode")
        (summary,) = (s for s in api.surrogates() if s.name == name)
    words = "4 of 8, 200 of evaluations"
    (line,) = (line for line in on_server("status").out.splitlines() if line.startswith(name))
    assert re.search(f"  {words}  ", line)
    assert f"real steps: {words}\nin the budget: 4 initial, 0 adaptive, 0 manual\n" in on_server("status", name).out
    audited = summary.model_copy(update={"ledger": wire.Ledger(initial=6, total=6, audit=8, logged=3)})
    assert status._steps(audited) == "6 of 8, 8 of audits, 3 logged"


def test_the_status_shows_resets_seconds_and_wear_of_the_machine(on_server, server_process, name, tmp_path):
    spec = json.loads(on_server("register", "Pendulum-v1", "--access", "reset", "--print-spec").out)
    file = tmp_path / "spec.json"
    file.write_text(json.dumps(spec | {"sampling_period": 0.05}))
    on_server("register", "Pendulum-v1", "--spec", str(file), "--name", name, "--budget", "8")
    assert "of the machine" not in on_server("status", name).out
    on_server("sample", name, "--spec", str(file), "--max-queries", "1", "--time-limit", "60")
    with Api(server_process.url) as api:
        samples, view = list(api.samples(name)), api.surrogate(name)
    wear = sum(abs(sample.action[0]) >= 2.0 for sample in samples)
    assert (view.ledger.resets, view.ledger.wear) == (1, wear)
    assert view.machine_seconds == len(samples) * 0.05
    words = f"of the machine: 1 reset, {len(samples) * 0.05:.4g} s without resets, {wear} step"
    assert words in on_server("status", name).out
    assert on_server("status", name, "--json").json["ledger"]["wear"] == wear


def test_the_status_names_the_dirt_of_the_first_real_steps_in_the_words_of_doctor(on_server, server_process, name):
    with Api(server_process.url) as api:
        spec = learned(api, name, "--seed", "1")
        samples = list(api.samples(name))
    rollouts = [
        Rollout(
            np.array([steps[0].coordinates, *(step.next_coordinates for step in steps)]),
            np.array([step.action for step in steps]),
        )
        for steps in ([s for s in samples if s.trajectory == t] for t in sorted({s.trajectory for s in samples}))
    ]
    known = sensors(spec)
    found = dict(traits(identify(rollouts, known), known, spec, rollouts))
    assert {"dead time", "encoder"} <= found.keys()
    out, dirt = on_server("status", name).out, on_server("status", name, "--json").json["dirt"]
    assert all(f"\n{kind}: {said}\n" in f"{out}\n" for kind, said in found.items())
    assert found.items() <= {(finding["name"], finding["said"]) for finding in dirt}


def test_the_status_of_a_clean_machine_names_no_dirt(on_server, server_process, name):
    with Api(server_process.url) as api:
        learned(api, name, "--seed", "1", "--clean")
        assert api.surrogate(name).ledger.total == 60
    assert "actions take effect" not in on_server("status", name).out
    assert "dirt" not in on_server("status", name, "--json").json


def test_the_status_of_a_design_with_failed_queries_recommends_resume(on_server, server_process, name):
    on_server("register", "Pendulum-v1", "--name", name, "--budget", "8", "--initial", "4")
    with Api(server_process.url) as api:
        while api.surrogate(name).phase != "failed":
            for query in api.claim(name, "w", max_queries=4, wait_seconds=1.0, lease_seconds=60.0).queries:
                api.fail(name, query.id, query.lease_token, "no power", begun=True)
    assert (
        f"4 set aside because they failed; surrogym change {name} --resume queues those of the design again"
        in on_server("status", name).out.replace("\n", " ")
    )
    sampled = on_server("sample", name, "--until-done")
    assert sampled.code == 1
    assert f"surrogym change {name} --resume" in sampled.out.replace("\n", " ")
    assert "collecting" in on_server("change", name, "--resume").out


def test_the_status_command_with_watch_prints_only_changes_and_ends_cleanly(on_server, server_process, name, looks):
    """Not on a terminal: as lines."""
    on_server("register", "Pendulum-v1", "--name", name)
    looks(5)
    watched = on_server("status", name, "--watch", "--json")
    assert watched.code == 0
    (seen,) = map(json.loads, watched.out.splitlines())
    assert seen["name"] == name
    looks(2)
    with Api(server_process.url) as api:
        assert api.patch_surrogate(name, paused=True).paused
    assert on_server("status", name, "--watch", "--quiet").out == f"{name} paused\n"


def test_the_status_command_with_watch_reports_a_lost_server_and_tries_again(surrogym, looks, monkeypatch):
    monkeypatch.setattr("surrogym.cli.options.QUICK", 0.0)
    looks(3)
    with scripted_server(EMPTY, lost_reply, EMPTY) as server:
        said = surrogym("status", "--watch", "--server", server.url)
    assert said.code == 0
    lost, found = said.out.splitlines()
    assert "trying again" in lost
    assert found.startswith("no surrogates yet")


def test_the_status_command_with_watch_of_an_unknown_surrogate_ends_at_once(on_server):
    said = on_server("status", "nobody", "--watch")
    assert (said.code, said.out) == (1, "")


def test_the_status_command_with_watch_fits_a_narrow_terminal_and_ends_with_ctrl_c(pendulum_server):
    with on_terminal("status", "pendulum", "--watch", "--server", pendulum_server.url, width=60) as terminal:
        terminal.await_text("leave-one-out")
        assert terminal.interrupt() == 0
    lines = terminal.shown.splitlines()
    assert [line for line in lines if len(line) > 60] == []
    assert "Traceback" not in terminal.shown
    assert {f"output               {name}" for name in ("theta", "speed", "reward")} <= set(lines)


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-"])
def test_a_command_with_a_closed_standard_stream_ends_as_usual(on_server, server_process, name, closed):
    on_server("register", "Pendulum-v1", "--name", name)
    script = f'"{sys.executable}" -m surrogym status --server {server_process.url} {closed}'
    ended = subprocess.run(["sh", "-c", script], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
