"""The thin client stays thin: what a trainer's process loads to step a surrogate."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

MOST_LINES = 6_000
THIN = ("surrogym_client", "surrogym_shared")
NEVER = ("torch", "scipy", "matplotlib", "stable_baselines3")
STEPPED = """
import json, sys
import gymnasium, surrogym_client

env = gymnasium.make("surrogym/Remote-v0", surrogate="pendulum", transport=sys.argv[1], seed=0)
env.reset(seed=0)
env.step(env.action_space.sample())
env.close()
print(json.dumps({name: getattr(module, "__file__", None) for name, module in sys.modules.items()}))
"""


@pytest.mark.parametrize("transport", ["stream", "binary", "json"])
def test_a_stepped_surrogate_loads_few_lines_no_original_environment_and_no_logs(
    pendulum_server, transport: str
) -> None:
    environment = {**os.environ, "SURROGYM_URL": pendulum_server.url}
    ran = subprocess.run(
        [sys.executable, "-c", STEPPED, transport], env=environment, capture_output=True, text=True, check=True
    )
    files = json.loads(ran.stdout)
    ours = {name: file for name, file in files.items() if name.startswith("surrogym") and file}
    counts = {name: _lines(file) for name, file in ours.items()}
    assert sum(counts.values()) <= MOST_LINES, sorted(counts.items(), key=lambda item: -item[1])
    assert {name.partition(".")[0] for name in ours} <= set(THIN)
    client = {name.split(".")[1] for name in ours if name.startswith("surrogym_client.")}
    assert client <= {"environments", "transport", "errors", "registration", "runtime"}
    assert not [name for name in NEVER if name in files]
    assert not [name for name in ours if name.startswith("surrogym_shared.logs")]


def _lines(file: str) -> int:
    with open(file, encoding="utf-8") as opened:
        return sum(1 for _ in opened)
