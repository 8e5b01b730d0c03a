"""Training by an algorithm of Stable-Baselines3, for a fixed number of steps. The best policy of all checks is kept.

A callback checks a training by the policy's imagined return. Training curves go to TensorBoard, Weights & Biases or
MLflow.
"""

from __future__ import annotations

import inspect
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
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
from surrogym_trainer.training.checks import Checks, Returns, checked
from surrogym_trainer.training.search import Found, PolicySearch, SearchTask
from surrogym_trainer.training.settings import CHECKS, TrainProgress, TrainSettings, suggested_gamma

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
        """Train until the steps are taken, Ctrl-C is pressed, or a step fails."""
        checking, stopped = self._checking, None
        if self._learner.tensorboard_log is None:  # without a logger, Stable-Baselines3 would make a temporary folder
            self._learner.set_logger(Logger(folder=None, output_formats=[]))
        with tracking(self._task.settings, self._task.out) as callbacks:
            try:
                self._learner.learn(self._total, callback=[checking, *callbacks])
            except (KeyboardInterrupt, Exception) as error:
                stopped = error
        best = checking.best_of(self._learner)
        ran_with = {"num_envs": self._env.num_envs, "total_steps": self._total, **effective(best)}
        return Found(
            LearnedPolicy(best),
            checking.steps,
            checking.checks.best,
            ran_with,
            type(best).__name__,
            stopped is None,
            stopped,
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


class Checking(BaseCallback):
    """Callback that measures the imagined return, keeps the best policy, and reports progress and the penalty's size.

    Args:
        total: virtual steps of the training.
        progress: called after every rollout.
        imagine: measures a learner's returns in virtual episodes.
        untrained: a learner with an untrained network.
    """

    def __init__(
        self,
        total: int,
        progress: Callable[[TrainProgress], None],
        imagine: Callable[[BaseAlgorithm], Returns],
        untrained: BaseAlgorithm,
    ) -> None:
        super().__init__()
        self._total, self._progress, self._imagine = total, progress, imagine
        self.checks = Checks(imagine(untrained))
        # the best learner, and its parameters at the check
        self._kept: tuple[BaseAlgorithm, dict[str, Any]] | None = None
        self._penalty = self._size = 0.0
        self._penalties: deque[float] = deque(maxlen=100)  # penalties for uncertainty of the last episodes
        self._checked = 0  # number of checks that were due so far
        self.steps = self.lost = 0

    @property
    def episode_penalty(self) -> float | None:
        return float(np.mean(self._penalties)) if self._penalties else None

    def check(self, learner: BaseAlgorithm) -> None:
        """Measure a policy, and keep it if it is the best so far."""
        if self.checks.add(self._imagine(learner)):
            self._kept = learner, {name: tensor.clone() for name, tensor in learner.policy.state_dict().items()}

    def best_of(self, last: BaseAlgorithm) -> BaseAlgorithm:
        """Return the learner with the best imagined return of all checks, with its parameters of that check.

        If there was no check, the last learner is returned.
        """
        if self._kept is None:
            return last
        learner, parameters = self._kept
        learner.policy.load_state_dict(parameters)
        return learner

    def _on_step(self) -> bool:
        infos, env = self.locals["infos"], self.training_env
        assert isinstance(env, VecNormalize)
        reward = env.get_original_reward()
        mean = np.array([info["reward_mean"] for info in infos])
        self._penalty += float(np.abs(mean - reward).sum())
        self._size += float(np.abs(mean).sum())
        self._penalties.extend(info["penalty"] for info in infos if "penalty" in info)
        self.steps = self.num_timesteps
        self.lost += sum("surrogym_session_lost" in info for info in infos)
        return True

    def _on_rollout_end(self) -> None:
        share = self._penalty / self._size if self._size else 0.0
        self._penalty = self._size = 0.0
        self.logger.record("surrogym/penalty_share", share)
        due = self.steps * CHECKS // self._total
        if due > self._checked:
            self._checked = due
            self._check_now()
        steps = min(self.steps, self._total)
        self._progress(TrainProgress(steps, self._total, self.checks.latest, share, self.episode_penalty))

    def _on_training_end(self) -> None:
        self._check_now()

    def _check_now(self) -> None:
        self.check(self.model)
        self.logger.record("surrogym/imagined_return", self.checks.latest)


PROJECT = "surrogym"  # project or experiment of the runs in Weights & Biases and MLflow


@contextmanager
def tracking(settings: TrainSettings, out: Path) -> Iterator[list[BaseCallback]]:
    """Context manager that returns the callbacks of a training's tracker. The tracker's run ends with the context.

    TensorBoard needs no callback. Addresses and keys come from the trackers' own environment variables, such as
    ``WANDB_MODE`` and ``MLFLOW_TRACKING_URI``.

    Raises:
        ModuleNotFoundError: the tracker is not installed.
    """
    config = {name: str(value) for name, value in asdict(settings).items() if value not in (None, {})}
    if settings.tracker == "wandb":
        import wandb
        from wandb.integration.sb3 import WandbCallback

        out.parent.mkdir(parents=True, exist_ok=True)
        with wandb.init(project=PROJECT, name=out.stem, config=config, dir=out.parent, sync_tensorboard=True):
            yield [WandbCallback()]
    elif settings.tracker == "mlflow":
        import mlflow

        mlflow.set_experiment(PROJECT)
        with mlflow.start_run(run_name=out.stem):
            mlflow.log_params(config)
            yield [Mlflow()]
    else:
        yield []


class Mlflow(BaseCallback):
    """Callback that sends the algorithm's logged numbers to the active run of MLflow."""

    def _on_training_start(self) -> None:
        self.logger.output_formats.append(MlflowWriter())

    def _on_step(self) -> bool:
        return True


class MlflowWriter(KVWriter):
    """Output format of Stable-Baselines3's logger that logs numbers as metrics of MLflow."""

    def write(self, key_values: dict[str, Any], key_excluded: Mapping[str, Any], step: int = 0) -> None:
        import mlflow

        numbers = {
            name: float(value)
            for name, value in key_values.items()
            if isinstance(value, int | float) and "mlflow" not in (key_excluded[name] or ())
        }
        mlflow.log_metrics(numbers, step=step)

    def close(self) -> None:
        """Do nothing: the context manager of the run closes the run."""
