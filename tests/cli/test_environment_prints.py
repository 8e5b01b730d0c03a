"""What an environment prints is not part of a command's output, and it does not end the command in silence."""

from __future__ import annotations

import subprocess
import sys

import pytest

CHATTY = """
import gymnasium
import numpy as np

class Chatty(gymnasium.Env):
    action_space = gymnasium.spaces.Box(-1, 1, (1,))
    observation_space = gymnasium.spaces.Box(-1, 1, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        print("a reset")
        self.state = self.np_random.uniform(-1, 1, 2)
        return self.state, {}

    def step(self, action):
        print("a step")
        self.state = 0.9 * self.state + 0.1 * action[0]
        return self.state, -float(self.state @ self.state), False, False, {}

gymnasium.register("Chatty-v0", entry_point=Chatty)
"""


@pytest.mark.parametrize(
    "command",
    [
        ("describe", "chatty_env:Chatty-v0", "--steps", "40"),
        ("doctor", "--server", "http://127.0.0.1:9", "--env", "chatty_env:Chatty-v0", "--json"),
        ("register", "chatty", "--env", "chatty_env:Chatty-v0", "--print-spec"),
    ],
)
def test_json_output_is_valid_although_the_environment_prints(surrogym, tmp_path, monkeypatch, command) -> None:
    (tmp_path / "chatty_env.py").write_text(CHATTY)
    monkeypatch.syspath_prepend(tmp_path)
    said = surrogym(*command)
    assert isinstance(said.json, dict), said.out
    assert "a step" in said.err


def test_an_environment_that_calls_exit_on_close_gives_a_one_sentence_error(surrogym, tmp_path, monkeypatch) -> None:
    """The command ended without a word."""
    closes = "    def close(self):\n        raise SystemExit('licence expired')\n\ngymnasium.register("
    (tmp_path / "closing_env.py").write_text(CHATTY.replace("gymnasium.register(", closes).replace("Chatty-v0", "C-v0"))
    monkeypatch.syspath_prepend(tmp_path)
    said = surrogym("register", "chatty", "--env", "closing_env:C-v0", "--print-spec")
    assert said.code == 1
    assert "error: the environment ended the program: SystemExit: licence expired (closing_env.py:" in said.err


FACTORY = """
from surrogym_sampler.original import RealStep
from surrogym_sampler.original.classic import pendulum

class Pendulum:
    def spec(self):
        return pendulum().model_copy(update={"environment": "chatty_plant:Pendulum"})

    def step_from(self, coordinates, action):
        print("a step", flush=True)
        return RealStep(coordinates, action, coordinates, 0.0)

    def close(self):
        pass
"""


def test_prints_of_an_environment_in_a_separate_process_stay_out_of_stdout(tmp_path) -> None:
    (tmp_path / "chatty_plant.py").write_text(FACTORY)
    command = [sys.executable, "-m", "surrogym", "doctor", "--server", "http://127.0.0.1:9"]
    said = subprocess.run(
        [*command, "--env", "chatty_plant:Pendulum"], cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert "a step" not in said.stdout
    assert "a step" in said.stderr
