"""The base install, client and shared alone, is enough to step a surrogate and for Gymnasium's own checks of it."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from support.distributions import absent
from support.server import ServerProcess

CHECKED = """
import json, sys, warnings

url, missing = sys.argv[1], json.load(sys.stdin)
assert {"pygame", "torch", "stable_baselines3"} <= set(missing)
sys.modules.update(dict.fromkeys(missing))  # importing one of them fails as if it were not installed

import gymnasium
from gymnasium.utils.env_checker import check_env
import surrogym_client

warnings.simplefilter("error")
warnings.filterwarnings("ignore", ".*symmetric and normalized")  # Pendulum's torque is in [-2, 2]
env = gymnasium.make("surrogym/Remote-v0", url=url, surrogate="pendulum")
check_env(env.unwrapped)
env.close()
"""


@pytest.fixture(scope="module")
def missing() -> list[str]:
    """The modules installed here that the base install does not bring."""
    return absent("surrogym")


def test_gymnasiums_environment_checker_passes_with_the_base_install_only(
    pendulum_server: ServerProcess, missing: list[str]
) -> None:
    command = [sys.executable, "-c", CHECKED, pendulum_server.url]
    done = subprocess.run(command, input=json.dumps(missing), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
