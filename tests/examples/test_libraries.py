"""What other libraries do with an environment of Gymnasium they do with a surrogate; each program is one way in."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from support.examples import EXTRAS, ROOT, needs_extras, run
from support.server import ServerProcess

TORCHRL_BY_ID = """
import surrogym_client
from torchrl.envs import GymEnv, SerialEnv, check_env_specs

env = GymEnv("surrogym/Remote-v0", surrogate="pendulum")
check_env_specs(env)
assert len(env.rollout(50)) == 50
env.close()
options = {"surrogate": "pendulum", "time_limit": 20}
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

GymWrapper(gymnasium.make_vec("surrogym/Remote-v0", 3, surrogate="pendulum", autoreset_mode="same_step")).close()
for mode in ("same_step", "disabled"):
    lanes = gymnasium.make_vec("surrogym/Remote-v0", 3, surrogate="pendulum", time_limit=6, autoreset_mode=mode)
    env = GymWrapper(lanes)
    check_env_specs(env)
    ended = env.rollout(24, break_when_any_done=False)["next", "truncated"].squeeze(-1)
    assert ended.nonzero()[:, 1].tolist() == 3 * [5, 11, 17, 23], ended
    env.close()
"""
TIANSHOU_LANES = """
import gymnasium
import numpy as np
import surrogym_client
from tianshou.env import DummyVectorEnv
from train_tianshou import SurrogateVectorEnv

together = SurrogateVectorEnv(None, "pendulum", num_envs=3)
apart = DummyVectorEnv([lambda: gymnasium.make("surrogym/Remote-v0", surrogate="pendulum")] * 3)
assert len(together) == len(apart) == 3
assert together.action_space == apart.action_space

def assert_same(ours, theirs):  # but for rounding, which goes by the number of lanes that are computed together
    for our, their in zip(ours[:-1], theirs[:-1], strict=True):
        np.testing.assert_allclose(our, their, rtol=1e-5, atol=1e-5)
    assert [info.keys() for info in ours[-1]] == [info.keys() for info in theirs[-1]]

together.seed([4, 5, 6])  # for the next reset
starts = [apart.reset([lane], seed=4 + lane)[0][0] for lane in range(3)]
np.testing.assert_allclose(together.reset()[0], starts, rtol=1e-5, atol=1e-5)
assert_same(together.reset(seed=7), apart.reset(seed=7))
actions = np.random.default_rng(0).uniform(-2, 2, (12, 3, 1)).astype(np.float32)
for action in actions[:5]:
    assert_same(together.step(action), apart.step(action))
assert_same(together.reset([0, 2]), apart.reset([0, 2]))  # as from a collector that no longer wants lane 1
for action in actions[5:10]:
    assert_same(together.step(action[:2], [0, 2]), apart.step(action[:2], [0, 2]))
together.close(), apart.close()
"""
TIANSHOU_FACTORY = """
import surrogym_client
from tianshou.highlevel.env import EnvFactoryRegistered, VectorEnvType

factory = EnvFactoryRegistered(task="surrogym/Remote-v0", venv_type=VectorEnvType.DUMMY, surrogate="pendulum")
environments = factory.create_envs(2, 1)
assert environments.training_envs.reset()[0].shape == (2, 3)
environments.training_envs.close()
"""
SB3_CONTRIB = """
from sb3_contrib import TQC, RecurrentPPO
from surrogym_client.sb3 import SurrogateVecEnv

settings = {RecurrentPPO: ("MlpLstmPolicy", {"n_steps": 8, "batch_size": 16}), TQC: ("MlpPolicy", {"batch_size": 8})}
for algorithm, (policy, options) in settings.items():
    lanes = SurrogateVecEnv(None, "pendulum", num_envs=4)
    algorithm(policy, lanes, device="cpu", **options).learn(32)
    lanes.close()
"""
GYMNASIUM = """
import gymnasium
import surrogym_client

for env in (
    gymnasium.make("surrogym/Remote-v0", surrogate="pendulum"),
    gymnasium.make_vec("surrogym/Remote-v0", 8, surrogate="pendulum"),
):
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
"""
PROGRAMS = {
    "torchrl_by_id": TORCHRL_BY_ID,
    "torchrl_lanes": TORCHRL_LANES,
    "tianshou_lanes": TIANSHOU_LANES,
    "tianshou_factory": TIANSHOU_FACTORY,
    "sb3_contrib": SB3_CONTRIB,
}


PAGE = ROOT / "docs" / "how-to" / "trainers.md"


def test_the_library_examples_in_the_how_to_page_are_those_tested() -> None:
    table = PAGE.read_text(encoding="utf-8").partition("| library | line |")[2].partition("\n\n")[0]
    lines = re.findall(r"\| `([^`]+)`", table)
    assert len(lines) == 8
    assert [line for line in lines if not any(line in program for program in (GYMNASIUM, *PROGRAMS.values()))] == []


def test_the_gymnasium_example_program_runs(server: ServerProcess, tmp_path: Path) -> None:
    run(server, tmp_path, "-c", GYMNASIUM)


@needs_extras
@pytest.mark.parametrize("name", PROGRAMS)
def test_the_example_program_of_every_supported_library_runs(server: ServerProcess, tmp_path: Path, name: str) -> None:
    run(server, tmp_path, "-c", PROGRAMS[name], python=str(EXTRAS))
