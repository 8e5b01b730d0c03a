"""Training by an algorithm of Stable-Baselines3, for a fixed number of steps. The best policy of all checks is kept."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from surrogym_client.sb3 import SurrogateVecEnv
from surrogym_shared.port import SurrogatePort
from surrogym_shared.spec import EnvironmentSpec
from surrogym_trainer.evaluation.imagined import observation_statistics
from surrogym_trainer.policies.files import load_learner, save_policy
from surrogym_trainer.policies.networks import Standardise
from surrogym_trainer.policies.predict import Predict
from surrogym_trainer.training.checks import Returns, checked
from surrogym_trainer.training.derived_settings import suggested_gamma
from surrogym_trainer.training.search import Found, PolicySearch, SearchTask
from surrogym_trainer.training.settings import TrainSettings
from surrogym_trainer.training.stable_baselines.callback import Checking
from surrogym_trainer.training.stable_baselines.tracking import tracking

Statistics = tuple[Sequence[float], Sequence[float]]  # mean and standard deviation of observations, (D,) each


@dataclass(frozen=True)
class LearnedPolicy:
    """A policy of a Stable-Baselines3 algorithm, which can be saved."""

    learner: BaseAlgorithm

    def save(self, path: Path) -> None:
        """Write the zip of Stable-Baselines3, with a description from which it can be read without unpickling."""
        save_policy(self.learner, path)


class StableBaselinesSearch(PolicySearch):
    """Policy search by one algorithm of Stable-Baselines3. Its hyperparameters are passed to the algorithm's
    constructor and replace its defaults."""

    algorithm: ClassVar[type[BaseAlgorithm]]
    policy: ClassVar[type[BasePolicy] | str]
    lanes: ClassVar[int]  # default number of virtual environments that step together
    tracked = True
    whole_episodes = False

    def __init__(self, **hyperparameters: Any) -> None:
        self.hyperparameters = hyperparameters

    def search(self, task: SearchTask) -> Found:
        torch.set_num_threads(task.settings.threads)
        gamma = self.hyperparameters.get("gamma", suggested_gamma(task.port.spec()))
        with self._environment(task, gamma) as env:
            return _Training(self, task, env, gamma).run()

    def explorer(self, policy: Path, algorithm: str, num_envs: int) -> Predict:
        learner = load_learner(policy, algorithm)
        if learner.use_sde:
            noisy: Any = learner.policy
            noisy.reset_noise(num_envs)  # each lane has exploration noise of its own
        return lambda observation: learner.predict(observation, deterministic=False)[0]

    def defaults(self, env: VecNormalize) -> dict[str, Any]:  # noqa: ARG002  for algorithms that have some
        """Return the hyperparameters that replace Stable-Baselines3's own defaults."""
        return {}

    def network(self, spec: EnvironmentSpec) -> dict[str, Any]:  # noqa: ARG002
        """Return the keyword arguments that define the policy network, without those that standardise observations."""
        return {}

    @contextmanager
    def _environment(self, task: SearchTask, gamma: float) -> Iterator[VecNormalize]:
        settings = task.settings
        lanes = settings.num_envs or self.lanes
        env = SurrogateVecEnv.from_port(task.port, lanes, **settings.learning)
        wrapped = VecNormalize(VecMonitor(env), norm_obs=False, norm_reward=True, gamma=gamma)
        try:
            yield wrapped
        finally:
            wrapped.close()


class _Training:
    """A training of one network, with the checks of its policy."""

    def __init__(self, search: StableBaselinesSearch, task: SearchTask, env: VecNormalize, gamma: float) -> None:
        self._search, self._task, self._env, self._gamma = search, task, env, gamma
        settings, self._spec = task.settings, task.port.spec()
        self._statistics = observation_statistics(task.port, settings.seed)
        saved = None if settings.start_from is None else self._made(settings.start_from)
        new = self._made()
        self._learner = new if saved is None or settings.anew else saved
        self._total = _whole_rollouts(self._learner, task.steps)
        self._checking = Checking(
            self._total, task.progress, lambda learner: imagined_returns_of(task.port, learner, settings), new
        )
        if saved is not None:
            self._checking.check(saved)  # the saved policy stays the best if the training does not exceed it

    def run(self) -> Found:
        """Train until the steps are taken, or Ctrl-C is pressed."""
        checking, whole = self._checking, True
        if self._learner.tensorboard_log is None:  # without a logger, Stable-Baselines3 would make a temporary folder
            self._learner.set_logger(Logger(folder=None, output_formats=[]))
        with tracking(self._task.settings, self._task.out) as callbacks:
            try:
                self._learner.learn(self._total, callback=[checking, *callbacks])
            except KeyboardInterrupt:
                whole = False
        best = checking.best_of(self._learner)
        ran_with = {"num_envs": self._env.num_envs, "total_steps": self._total, **effective(best)}
        return Found(
            LearnedPolicy(best),
            checking.steps,
            checking.checks.best,
            ran_with,
            type(best).__name__,
            whole,
            checking.episode_penalty,
            checking.lost,
            untrained=checking.checks.untrained,
        )

    def _made(self, start_from: Path | None = None) -> BaseAlgorithm:
        settings = replace(self._task.settings, start_from=start_from)
        return make_learner(self._search, self._env, settings, self._spec, self._statistics, self._gamma)


def make_learner(
    search: StableBaselinesSearch,
    env: VecNormalize,
    settings: TrainSettings,
    spec: EnvironmentSpec,
    statistics: Statistics,
    gamma: float,
) -> BaseAlgorithm:
    """Make a new network, or load the policy of ``settings.start_from``.

    Args:
        search: the policy search.
        env: the virtual environment to learn in.
        settings: settings of the training.
        spec: specification of the environment.
        statistics: mean (D,) and standard deviation (D,) of observations.
        gamma: discount factor.

    Raises:
        ValueError: the algorithm does not support this surrogate.
        UnusablePolicy: the saved policy can't be read, or does not fit the surrogate.
    """
    algorithm, tensorboard = search.algorithm, None if settings.tensorboard is None else str(settings.tensorboard)
    if settings.start_from is not None:
        changes = {**settings.hyperparameters, "env": env, "seed": settings.seed}
        learner = load_learner(settings.start_from, algorithm.__name__, trust=settings.trust_policy, **changes)
        learner.tensorboard_log = tensorboard
        return learner
    extractor = {"mean": statistics[0], "deviation": statistics[1]}
    try:
        return algorithm(
            search.policy,
            env,
            seed=settings.seed,
            device="cpu",
            policy_kwargs={
                "features_extractor_class": Standardise,
                "features_extractor_kwargs": extractor,
                **search.network(spec),
            },
            tensorboard_log=tensorboard,
            **({"gamma": gamma} | search.defaults(env) | settings.hyperparameters),
        )
    except (AssertionError, TypeError) as error:
        raise ValueError(
            f"algorithm {settings.algorithm} can't be trained in this surrogate: {error}; choose another algorithm"
        ) from error


def imagined_returns_of(port: SurrogatePort, learner: BaseAlgorithm, settings: TrainSettings) -> Returns:
    """Return the returns of the current policy in virtual episodes without exploration, from the same starts at every
    check."""

    def predict(observation: Any) -> Any:
        return learner.predict(observation, deterministic=True)[0]

    return checked(port, predict, settings)


def effective(learner: BaseAlgorithm) -> dict[str, Any]:
    """Return the algorithm's settings that are numbers or text, including defaults, and those of the network."""
    names = inspect.signature(type(learner).__init__).parameters
    given = {name: getattr(learner, name, None) for name in names if name not in ("self", "seed", "verbose")}
    plain = {name: value for name, value in given.items() if isinstance(value, bool | int | float | str)}
    return {**plain, "net_arch": learner.policy_kwargs.get("net_arch")}


def _whole_rollouts(learner: BaseAlgorithm, total: int) -> int:
    """Round a number of steps down to whole rollouts, at least one. Stable-Baselines3 would round up."""
    rollout = learner.n_envs * (learner.n_steps if isinstance(learner, OnPolicyAlgorithm) else 1)
    return max(total // rollout, 1) * rollout
