"""Methods of the study by name, and the tasks that they learn. Importing this imports no method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from surrogym.demo.tasks import DemoTask, Target
from surrogym_lab.peers.port import Peer
from surrogym_lab.tasks import EVERY_TASK
from surrogym_sampler.original.loading import has_specification
from surrogym_shared.spec import EnvironmentSpec

OURS = ("default", "latin_hypercube")  # arms of the efficiency study
CORE = ("pendulum", "cartpole", "swingup", "acrobot")
SHARE, LEAST = 10, 1_000  # a peer's real steps: this many times ours, and at least as many
OWN_BUDGET = 100  # real steps of ours for a task that is none of the demo


@dataclass(frozen=True)
class Method:
    """A peer of the study.

    Attributes:
        words: what it is.
        make: builds the peer; imports its libraries.
        budget: real steps; None follows the task's budget.
        episodes: of an evaluation.
        check: raises ``NotApplicable`` for the specification of a task that it can't learn, as far as that is cheaply
            known beforehand.
    """

    words: str
    make: Callable[[], Peer]
    budget: int | None = None
    episodes: int = 100
    check: Callable[[EnvironmentSpec], object] | None = None

    def real_steps(self, task: DemoTask) -> int:
        return self.budget or max(LEAST, SHARE * task.budget)


def _sac() -> Peer:
    from surrogym_lab.peers.methods.model_free import ModelFree

    return ModelFree("SAC", boxed=True)


def _ppo() -> Peer:
    from surrogym_lab.peers.methods.model_free import ModelFree

    return ModelFree("PPO", boxed=False)


def _pilco() -> Peer:
    from surrogym_lab.peers.methods.pilco import Pilco

    return Pilco()


def _black_drops() -> Peer:
    from surrogym_lab.peers.methods.black_drops import BlackDrops

    return BlackDrops()


def _pets() -> Peer:
    from surrogym_lab.peers.methods.pets import Pets

    return Pets()


def _mbpo() -> Peer:
    from surrogym_lab.peers.methods.mbpo import Mbpo

    return Mbpo()


def _world_model() -> Peer:
    from surrogym_lab.peers.methods.world_model import WorldModel

    return WorldModel()


def _bayesian_network() -> Peer:
    from surrogym_lab.peers.methods.bayesian_network import BayesianNetwork

    return BayesianNetwork()


def _local_processes() -> Peer:
    from surrogym_lab.peers.methods.local_processes import LocalProcesses

    return LocalProcesses()


def _knows_reward(spec: EnvironmentSpec) -> None:
    from surrogym_lab.peers.methods.told import told

    told(spec)


METHODS = {
    "pilco": Method("PILCO: Gaussian processes, moment matching, gradients", _pilco, check=_knows_reward),
    "black_drops": Method(
        "Black-DROPS: Gaussian processes, sampled rollouts, CMA-ES", _black_drops, check=_knows_reward
    ),
    "pets": Method(
        "PETS: ensemble of networks, planning by the cross-entropy method", _pets, episodes=10, check=_knows_reward
    ),
    "mbpo": Method("MBPO: ensemble of networks, soft actor-critic on short rollouts", _mbpo),
    "world_model": Method("recurrent world model: mixture density network, CMA-ES in its dream", _world_model),
    "bayesian_network": Method(
        "a Bayesian network in PILCO's loop: dropout, particles, gradients", _bayesian_network, check=_knows_reward
    ),
    "local_processes": Method(
        "local Gaussian processes: the nearest samples only, in Black-DROPS' loop",
        _local_processes,
        check=_knows_reward,
    ),
    "sac": Method("soft actor-critic of Stable-Baselines3, model-free", _sac, budget=20_000),
    "ppo": Method("proximal policy optimisation of Stable-Baselines3, model-free", _ppo, budget=100_000),
}


def task_of(name: str) -> DemoTask:
    """The task of the demo called ``name``, or a user's environment ``package.module:Class``, which has no target.

    Raises:
        KeyError: it is neither.
    """
    if name not in EVERY_TASK and ":" in name:
        return DemoTask(name, OWN_BUDGET, Target("none"))
    task = EVERY_TASK[name]
    if not has_specification(task.environment):
        raise KeyError(name)
    return task
