"""PPO of tianshou: its collector talks to each lane by itself, and a step of all lanes is one request.

pip install . "tianshou>=2.0"
python train_tianshou.py pendulum --steps 50000

For continuous actions.
"""

import argparse
from functools import partial

import numpy as np
import torch
from tianshou.algorithm import PPO
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.env import BaseVectorEnv
from tianshou.env.worker import EnvWorker
from tianshou.trainer import OnPolicyTrainerParams
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic
from torch.distributions import Independent, Normal

from surrogym_client.environments.env import start_info, step_info
from surrogym_client.environments.lanes import Lanes, session_request
from surrogym_client.environments.spaces import space
from surrogym_client.transport.http_surrogate import HttpSurrogate

LANES, ROLLOUT = 32, 1024


class SurrogateVectorEnv(BaseVectorEnv):
    """Vector environment of tianshou whose lanes are virtual environments of one surrogate, stepped in one request.

    ``options`` are fields of ``OpenSession``: variant, seed, time_limit, penalty, ...
    """

    def __init__(self, url, surrogate, num_envs=16, **options):
        self._lanes = Lanes(HttpSurrogate(url, surrogate), session_request(num_envs, "disabled", options))
        calls = LaneCalls(self._lanes)
        super().__init__(
            [partial(Lane, calls, lane, self._lanes.view) for lane in range(num_envs)], lambda make: make()
        )

    def close(self):
        super().close()
        self._lanes.close()


class LaneCalls:
    """Collects resets and steps of single lanes, and sends them in one request when the first answer is read."""

    def __init__(self, lanes):
        self._lanes, self._seeds, self._actions, self._answers = lanes, {}, {}, {}

    def reset(self, lane, seed=None):
        self._seeds[lane] = seed

    def step(self, lane, action):
        self._actions[lane] = np.asarray(action)

    def answer(self, lane):
        """What ``Env.reset`` or ``Env.step`` returns for the lane's last call."""
        if lane not in self._answers:
            (seeds, self._seeds), (actions, self._actions) = (self._seeds, {}), (self._actions, {})
            if seeds:
                self._start(seeds)
            if actions:
                self._move(actions)
        return self._answers.pop(lane)

    def _start(self, seeds):
        start = self._lanes.reset([seeds.get(lane) for lane in range(self._lanes.num_envs)], self._mask(seeds))
        self._answers |= {lane: (start.observation[lane], start_info(start, lane)) for lane in seeds}

    def _move(self, actions):
        idle = np.zeros_like(next(iter(actions.values())))
        wanted = np.stack([actions.get(lane, idle) for lane in range(self._lanes.num_envs)])
        step = self._lanes.step(wanted, self._mask(actions))
        result = step.result
        self._answers |= {
            lane: (
                result.observation[lane],
                float(result.reward[lane]),
                bool(result.terminated[lane]),
                bool(result.truncated[lane]),
                step_info(step, lane),
            )
            for lane in actions
        }

    def _mask(self, called):
        mask = np.zeros(self._lanes.num_envs, dtype=bool)
        mask[list(called)] = True
        return None if mask.all() else mask


class Lane(EnvWorker):
    """One lane in the form of tianshou's environment worker. A seed takes effect at the next reset."""

    def __init__(self, calls, lane, view):
        self._calls, self._lane, self._seed = calls, lane, None
        self._attributes = {
            "observation_space": space(view.observation_space),
            "action_space": space(view.action_space),
            "metadata": {"render_modes": []},
            "render_mode": None,
            "spec": None,
        }
        super().__init__(None)

    def get_env_attr(self, key):
        if key not in self._attributes:
            raise AttributeError(f"a lane of a surrogate has no attribute {key!r}")
        return self._attributes[key]

    def set_env_attr(self, key, value):
        self._attributes[key] = value

    def send(self, action, **kwargs):
        """Note a step, or a reset if the action is None. A reset of a surrogate takes no options."""
        if action is None:
            self._calls.reset(self._lane, kwargs.get("seed", self._seed))
            self._seed = None
        else:
            self._calls.step(self._lane, action)

    def recv(self):
        return self._calls.answer(self._lane)

    def reset(self, **kwargs):
        self.send(None, **kwargs)
        return self.recv()

    def seed(self, seed=None):
        self._seed = seed
        return super().seed(seed)

    def render(self, **_):
        """A lane has no render mode."""

    def close_env(self):
        """Closing the vector environment closes the session."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("surrogate")
    parser.add_argument("--steps", type=int, default=50_000)
    parser.add_argument("--url", help="SURROGYM_URL, or http://127.0.0.1:8000, where it is not given")
    given = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)

    lanes = SurrogateVectorEnv(given.url, given.surrogate, num_envs=LANES, seed=0)
    observations, actions = lanes.get_env_attr("observation_space", 0)[0], lanes.get_env_attr("action_space", 0)[0]
    actor = ContinuousActorProbabilistic(
        preprocess_net=Net(state_shape=observations.shape, hidden_sizes=(64, 64), activation=torch.nn.Tanh),
        action_shape=actions.shape,
        unbounded=True,
    )
    policy = ProbabilisticActorPolicy(
        actor=actor,
        dist_fn=lambda loc_scale: Independent(Normal(*loc_scale), 1),
        action_space=actions,
        deterministic_eval=True,
    )
    algorithm = PPO(
        policy=policy,
        critic=ContinuousCritic(
            preprocess_net=Net(state_shape=observations.shape, hidden_sizes=(64, 64), activation=torch.nn.Tanh)
        ),
        optim=AdamOptimizerFactory(lr=1e-3),
        gamma=0.98,
        gae_lambda=0.9,
        ent_coef=0.0,
        return_scaling=True,
        max_grad_norm=0.5,
    )
    collector = Collector(algorithm, lanes, VectorReplayBuffer(ROLLOUT, LANES))
    algorithm.run_training(
        OnPolicyTrainerParams(
            training_collector=collector,
            max_epochs=1,
            epoch_num_steps=given.steps,
            collection_step_num_env_steps=ROLLOUT,
            update_step_num_repetitions=8,
            batch_size=256,
            show_progress=False,
            verbose=False,
        )
    )
    collector.reset()
    returns = collector.collect(n_episode=64).returns
    print(f"imagined return: {returns.mean():.1f}, deviation {returns.std():.1f} over {len(returns)} episodes")
    torch.save(algorithm.state_dict(), "tianshou.pt")
    lanes.close()


if __name__ == "__main__":
    main()
