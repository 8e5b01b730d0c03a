"""What other libraries do with an environment of Gymnasium they do with a surrogate; each program is one way in."""

from __future__ import annotations

from pathlib import Path

import pytest

from support.examples import EXTRAS, needs_extras, run
from support.server import ServerProcess

TORCHRL_BY_ID = """
import surrogym_client
from torchrl.envs import GymEnv, SerialEnv, check_env_specs

options = {"surrogate": "pendulum", "time_limit": 20}
env = GymEnv("surrogym/Remote-v0", **options)
check_env_specs(env)
assert len(env.rollout(50)) == 20
env.close()
twice = GymEnv("surrogym/Remote-v0", frame_skip=2, **options)
assert len(twice.rollout(50)) == 10
twice.close()
several = SerialEnv(2, lambda: GymEnv("surrogym/Remote-v0", **options))
assert several.rollout(50).shape == (2, 20)
several.close()
"""
TORCHRL_LANES = """
import gymnasium
import surrogym_client
from torchrl.envs import GymWrapper, check_env_specs

for mode in ("same_step", "disabled"):
    lanes = gymnasium.make_vec("surrogym/Remote-v0", 3, surrogate="pendulum", time_limit=6, autoreset_mode=mode)
    env = GymWrapper(lanes)
    check_env_specs(env)
    ended = env.rollout(24, break_when_any_done=False)["next", "truncated"].squeeze(-1)
    assert ended.nonzero()[:, 1].tolist() == 3 * [5, 11, 17, 23], ended
    env.close()
"""
PROGRAMS = {"torchrl_by_id": TORCHRL_BY_ID, "torchrl_lanes": TORCHRL_LANES}


@needs_extras
@pytest.mark.parametrize("name", PROGRAMS)
def test_a_library_takes_a_surrogate_as_it_takes_gymnasiums(server: ServerProcess, tmp_path: Path, name: str) -> None:
    run(server, tmp_path, "-c", PROGRAMS[name], python=str(EXTRAS))
