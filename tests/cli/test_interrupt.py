"""Ctrl-C on a terminal: a command shows how far it is, ends at once, says what was saved, and leaves it in order."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest

from support.server import ServerProcess
from support.terminal import Terminal, on_terminal
from surrogym.cli.commands.train import _keeping
from surrogym_client.transport import Api
from surrogym_sampler.original.errors import EvaluationFailed
from surrogym_shared.archives import stored
from surrogym_shared.limits import KeptEpisodes
from surrogym_trainer.evaluation import EvaluationInterrupted
from surrogym_trainer.policies import load_policy

INTERRUPTED = 130
LEFT = KeptEpisodes(2, 1, 3, 1, 6, {"rail": -0.1}, 0.01)  # one of two episodes left the rail


@pytest.fixture
def surrogym_on_terminal(pendulum_server: ServerProcess, tmp_path: Path):
    return lambda *arguments: on_terminal(*arguments, "--server", pendulum_server.url, width=140, folder=str(tmp_path))


def said(terminal: Terminal) -> str:
    """After Ctrl-C, as one line."""
    assert "Traceback" not in terminal.shown
    return " ".join(terminal.shown.split())


def test_interrupted_sampling_keeps_every_real_step(surrogym, pendulum_server, surrogym_on_terminal, name):
    register = ("register", "Pendulum-v1", "--name", name, "--budget", "6", "--initial", "4")
    assert surrogym(*register, "--server", pendulum_server.url).code == 0
    with surrogym_on_terminal("sample", name) as terminal:
        terminal.await_text("6 of 6 real steps (2 adaptive), confidence index")
        assert terminal.interrupt() == INTERRUPTED
    assert "interrupted after 6 queries answered with 6 real steps; all of them are stored" in said(terminal)
    with Api(pendulum_server.url) as api:
        view = api.surrogate(name)
    assert (view.ledger.total, view.queries.leased) == (6, 0)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupted_training_saves_its_policy(
    pendulum_server: ServerProcess, surrogym_on_terminal, tmp_path: Path, number: int
):
    """Ctrl-C, the stop of a service manager, and a terminal that is closed."""
    options = ("--steps", "900000", "--num-envs", "16", "--set", "n_steps=64", "--variant", "pathwise")
    with surrogym_on_terminal("train", "pendulum", *options, "--out", "policy.zip") as terminal:
        terminal.await_text("of about 899072 virtual steps")
        assert terminal.interrupt(number) == INTERRUPTED
    given = " ".join([*options, "--server", pendulum_server.url])
    again = f"surrogym train pendulum {given} --start-from policy.zip --out policy.zip"
    assert f"to continue: {again}" in said(terminal)
    load_policy(tmp_path / "policy.zip")
    card = json.loads((tmp_path / "policy.json").read_text())
    assert 0 < card["virtual_steps"] < 899_072
    assert card["spec"]["environment"] == "Pendulum-v1"


@pytest.mark.parametrize(
    ("ending", "code", "words"),
    [
        (EvaluationInterrupted(7, LEFT), INTERRUPTED, "interrupted after 7 real steps"),
        (EvaluationFailed(7, RuntimeError("no motor"), LEFT), 1, "failed after 7 real steps: RuntimeError: no motor"),
    ],
)
def test_an_interrupted_or_failed_evaluation_reports_its_real_steps(
    on_server, server_process, name, monkeypatch, tmp_path, ending, code, words
):
    assert on_server("register", "Pendulum-v1", "--name", name).code == 0
    (tmp_path / "policy.zip").write_bytes(stored({}))
    (tmp_path / "policy.json").write_text(json.dumps({"surrogate": name}))

    def ends(*_):
        raise ending

    monkeypatch.setattr("surrogym_trainer.policies.files.load_policy", lambda *_, **__: None)
    monkeypatch.setattr("surrogym_trainer.evaluation.evaluator.evaluate", ends)
    reported, report = [], Api.report_steps

    def reports(api, *given, **fields):
        reported.append((fields["episodes"], fields["limits"]))
        return report(api, *given, **fields)

    monkeypatch.setattr(Api, "report_steps", reports)
    ended = on_server("evaluate", "policy.zip", "--env", "Pendulum-v1")
    with Api(server_process.url) as api:
        assert api.surrogate(name).ledger.evaluation == 7
    [(episodes, counts)] = reported
    assert (episodes, counts.violations, counts.fallbacks, counts.fallback_episodes) == (2, 1, 3, 1)
    assert (ended.code, ended.out) == (code, "")
    assert words in ended.err


INTERRUPTS = """
import gymnasium
import numpy as np

class Interrupts(gymnasium.Env):
    action_space = gymnasium.spaces.Box(-1, 1, (1,))
    observation_space = gymnasium.spaces.Box(-1, 1, (2,))
    steps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.uniform(-1, 1, 2), {}

    def step(self, action):
        self.steps += 1
        if self.steps == 7:
            raise KeyboardInterrupt
        return self.np_random.uniform(-1, 1, 2), 0.0, False, False, {}

gymnasium.register("Interrupts-v0", entry_point=Interrupts)
"""


def test_an_interrupted_describe_reports_its_real_steps(surrogym, tmp_path, monkeypatch):
    """They ended without a word."""
    (tmp_path / "interrupts.py").write_text(INTERRUPTS)
    monkeypatch.syspath_prepend(tmp_path)
    for command, outcome in (
        (("describe", "interrupts:Interrupts-v0"), "nothing was described or registered"),
        (("register", "interrupts:Interrupts-v0", "--print-spec"), "nothing was registered"),
    ):
        ended = surrogym(*command)
        assert (ended.code, ended.out) == (INTERRUPTED, "")
        assert ended.err == f"interrupted after 7 real steps, which no ledger counts; {outcome}\n"


def test_an_interruption_before_the_first_real_step_reports_none_taken(surrogym, monkeypatch):
    def interrupts(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("surrogym_sampler.original.loading.make", interrupts)
    ended = surrogym("register", "Pendulum-v1")
    assert (ended.code, ended.out) == (INTERRUPTED, ""), ended.err
    assert ended.err == "interrupted before the first real step; nothing was registered\n"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_sigterm_stops_a_training_like_ctrl_c(capsys, number: int):
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt), _keeping(lambda _: None, "pendulum"):
        signal.raise_signal(number)
    assert "interrupted before there was a policy" in capsys.readouterr().err
    assert signal.getsignal(number) is before


def test_sigterm_ends_a_training_that_waits_with_a_sentence(on_server, server_process, name, monkeypatch):
    """It ended without a word."""
    assert on_server("register", "Pendulum-v1", "--name", name).code == 0
    monkeypatch.setattr("surrogym_client.surrogates.waiting.wait_for_start", lambda *_: signal.raise_signal(15))
    ended = on_server("train", name)
    assert (ended.code, ended.err) == (INTERRUPTED, "interrupted; the same command waits again\n")
