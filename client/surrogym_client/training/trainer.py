"""Training in the virtual environment: PPO with the paper's policies, or any Stable-Baselines3 algorithm by name.

Settings follow from properties of the specification alone (kind of action, time limit), never from a task's name.
"""

from __future__ import annotations

import inspect
import itertools
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import stable_baselines3
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from surrogym_client.evaluation.imagined import imagined_returns, observation_statistics
from surrogym_client.policies.files import load_learner, save_policy
from surrogym_client.policies.networks import WIDER, PaperPolicy, Standardise
from surrogym_client.policies.networks import decaying as _decaying  # files of before name it so
from surrogym_client.sb3 import SurrogateVecEnv
from surrogym_client.training.cma_es import EVOLUTION_STEPS, evolve
from surrogym_client.training.early_stopping import Checks
from surrogym_client.training.settings import (
    CHECK_EPISODES,
    EVOLUTION,
    TrainingInterrupted,
    TrainProgress,
    TrainResult,
    TrainSettings,
    prolongs,
)
from surrogym_client.training.tracking import tracking, with_folder
from surrogym_shared.port import SurrogatePort
from surrogym_shared.spec import EnvironmentSpec

MAX_STEPS = 10_000_000  # virtual steps that can be asked for: hours of PPO
ON_POLICY_STEPS = 600_000
OFF_POLICY_STEPS = 50_000  # these learn from every step, and take far longer for each
ATTEMPT_SEED = 1_000_003  # between the seeds of one training's networks
PPO_BATCH = 1_024  # most of a training is the update, and its cost goes by the batch
PPO_DEFAULTS: dict[str, Any] = {
    "n_steps": 128,
    "n_epochs": 10,
    "learning_rate": _decaying,
    "gae_lambda": 0.97,
}


def train(
    port: SurrogatePort,
    out: Path,
    settings: TrainSettings | None = None,
    progress: Callable[[TrainProgress], None] | None = None,
) -> TrainResult:
    """Learn a policy in the surrogate behind a port, and save it.

    Args:
        port: the surrogate.
        out: where the policy goes (an SB3 zip); beside it, with suffix .json, what it was trained with.
        settings: what to train.
        progress: called after every rollout.

    Raises:
        ValueError: an unknown algorithm, one that can't take the action space, or too many steps.
        SurrogymClientError: the surrogate can't be reached, or has no model yet; or the file to go on from is no policy
            of the algorithm.
        TrainingInterrupted: Ctrl-C came; the policy with the best imagined return so far is saved.
    """
    settings, spec = settings or TrainSettings(), port.spec()
    prolonged = prolongs(settings, spec)
    if settings.algorithm.upper() == EVOLUTION:
        if settings.tracker in ("wandb", "mlflow"):
            raise ValueError(f"{EVOLUTION} logs to no tracker: expected none, got {settings.tracker}")
        return evolve(port, out, settings, planned_steps(settings), progress)
    torch.set_num_threads(settings.threads)
    settings = with_folder(settings, out)
    algorithm = algorithm_by_name(settings.algorithm)
    total = planned_steps(settings)
    num_envs = settings.num_envs or suggested_lanes(algorithm)
    gamma = settings.hyperparameters.get("gamma", suggested_gamma(spec))
    env = SurrogateVecEnv.from_port(
        port, num_envs, seed=settings.seed, start_box=settings.start_box, **settings.session
    )
    wrapped = VecNormalize(VecMonitor(env), norm_obs=False, norm_reward=True, gamma=gamma)
    started = time.perf_counter()
    try:
        statistics = observation_statistics(port, settings.seed)

        def made(attempt: int, start_from: Path | None = None) -> BaseAlgorithm:
            asked = replace(settings, seed=settings.seed + ATTEMPT_SEED * attempt, start_from=start_from)
            if attempt and start_from is None:
                asked = _exploring_by_state(asked, algorithm, wrapped, spec)
            return _learner(algorithm, wrapped, asked, spec, statistics, gamma)

        saved = None if settings.start_from is None else made(0, settings.start_from)
        untrained = made(0)
        total = _whole_rollouts(untrained, total)
        waiting = saved if settings.anew else None
        checks = Checks(total, progress, lambda learner: imagined_return(port, learner, settings), untrained, waiting)

        def network(attempt: int) -> BaseAlgorithm:
            """A new one; when it is its turn the saved policy, where that earns more than an untrained one."""
            if saved is not None and attempt == int(settings.anew) and checks.worth_keeping(saved):
                return saved
            return made(attempt) if attempt else untrained

        with tracking(settings, out) as callbacks:
            last, whole = _learned(network, checks, callbacks, prolong=prolonged)
        learner = checks.best_of(last)
        out.parent.mkdir(parents=True, exist_ok=True)
        save_policy(learner, out)
    finally:
        wrapped.close()
    result = TrainResult(
        path=out,
        algorithm=algorithm.__name__,
        virtual_steps=checks.steps,
        seconds=time.perf_counter() - started,
        imagined_return=checks.best,
        episode_penalty=checks.episode_penalty,
        lost_episodes=checks.lost,
        networks=checks.networks,
        gaining=checks.gaining,
        settings={**asdict(settings), "num_envs": num_envs, "total_steps": total, **effective(learner)},
    )
    out.with_suffix(".json").write_text(json.dumps(asdict(result), indent=2, default=str) + "\n")
    if not whole:
        raise TrainingInterrupted(result)
    return result


def _learned(
    network: Callable[[int], BaseAlgorithm], checks: Checks, callbacks: Sequence[BaseCallback], *, prolong: bool
) -> tuple[BaseAlgorithm, bool]:
    """The network that learned last, and whether the training came to its end, and not to an interruption."""
    learner: BaseAlgorithm | None = None
    for attempt in itertools.count():
        try:
            learner = network(attempt)
            if learner.tensorboard_log is None:  # Stable-Baselines3 would make an empty folder among temporary files
                learner.set_logger(Logger(folder=None, output_formats=[]))
            _learn(learner, checks, callbacks)
            if prolong and not checks.given_up and checks.prolong():
                _learn(learner, checks, callbacks)
        except KeyboardInterrupt:
            if learner is None:
                raise
            return learner, False
        if not checks.given_up:
            return learner, True
    raise AssertionError("unreachable")


def _learn(learner: BaseAlgorithm, checks: Checks, callbacks: Sequence[BaseCallback]) -> None:
    """What is left of the steps. A training that is prolonged goes on with its learning rate from the middle."""
    steps = _whole_rollouts(learner, checks.left)
    learner.learn(steps, callback=[checks, *callbacks], reset_num_timesteps=not checks.prolonged)


def algorithm_by_name(name: str) -> type[BaseAlgorithm]:
    """A Stable-Baselines3 algorithm, in any case. Raises ValueError with the known names."""
    known = {n: a for n in dir(stable_baselines3) if isinstance(a := getattr(stable_baselines3, n), type)}
    known = {n: a for n, a in known.items() if issubclass(a, BaseAlgorithm)}
    found: type[BaseAlgorithm] | None = known.get(name.upper())
    if found is None:
        raise ValueError(f"unknown algorithm {name!r}: expected one of {', '.join(sorted([*known, EVOLUTION]))}")
    return found


def effective(learner: BaseAlgorithm) -> dict[str, Any]:
    """What the algorithm was made with, defaults included, as far as it is numbers and words; and the network."""
    names = inspect.signature(type(learner).__init__).parameters
    given = {name: getattr(learner, name, None) for name in names if name not in ("self", "seed", "verbose")}
    plain = {name: value for name, value in given.items() if isinstance(value, bool | int | float | str)}
    return {**plain, "net_arch": learner.policy_kwargs.get("net_arch")}


def suggested_gamma(spec: EnvironmentSpec) -> float:
    """A discount whose horizon, 1 / (1 - gamma), is a third of the time limit: 0.985 for 200 steps, 0.994 for 500."""
    return float(np.clip(1 - 3 / (spec.time_limit or 1_000), 0.9, 0.999))


def even_batch(rollout: int) -> int:
    """Rows of a batch, about 1,024, of which a rollout is a whole number; the whole rollout where it is smaller."""
    return next(rollout // k for k in range(max(rollout // PPO_BATCH, 1), rollout + 1) if rollout % k == 0)


def suggested_lanes(algorithm: type[BaseAlgorithm]) -> int:
    """On-policy algorithms want many lanes, the others learn once for each step of all of them."""
    return 128 if issubclass(algorithm, OnPolicyAlgorithm) else 4


def imagined_return(port: SurrogatePort, learner: BaseAlgorithm, settings: TrainSettings) -> float:
    """Mean imagined return of the policy as it is now, without exploration, on the same starts at every check."""

    def predict(observation: Any) -> Any:
        return learner.predict(observation, deterministic=True)[0]

    return float(imagined_returns(port, predict, CHECK_EPISODES, settings.seed, **settings.judging).mean())


def _learner(
    algorithm: type[BaseAlgorithm],
    env: VecNormalize,
    settings: TrainSettings,
    spec: EnvironmentSpec,
    statistics: tuple[Sequence[float], Sequence[float]],
    gamma: float,
) -> BaseAlgorithm:
    if settings.start_from is not None:
        changes = {**settings.hyperparameters, "env": env, "seed": settings.seed}
        learner = load_learner(settings.start_from, algorithm.__name__, trust=settings.trust_policy, **changes)
        learner.tensorboard_log = None if settings.tensorboard is None else str(settings.tensorboard)
        return learner
    extractor = {"mean": statistics[0], "deviation": statistics[1]}
    defaults: dict[str, Any] = {"gamma": gamma}
    policy_kwargs: dict[str, Any] = {"features_extractor_class": Standardise, "features_extractor_kwargs": extractor}
    if algorithm is stable_baselines3.PPO:
        defaults |= PPO_DEFAULTS
        rollout = env.num_envs * settings.hyperparameters.get("n_steps", PPO_DEFAULTS["n_steps"])
        defaults["batch_size"] = even_batch(rollout)
    own = issubclass(algorithm, OnPolicyAlgorithm)
    if own and spec.design.preset == "default":
        policy_kwargs["net_arch"] = WIDER
    try:
        return algorithm(
            PaperPolicy if own else "MlpPolicy",
            env,
            seed=settings.seed,
            device="cpu",
            policy_kwargs=policy_kwargs,
            tensorboard_log=None if settings.tensorboard is None else str(settings.tensorboard),
            **(defaults | settings.hyperparameters),
        )
    except (AssertionError, TypeError) as error:
        raise ValueError(f"{settings.algorithm} can't be trained here: {error}") from error


def _exploring_by_state(
    settings: TrainSettings, algorithm: type[BaseAlgorithm], env: VecNormalize, spec: EnvironmentSpec
) -> TrainSettings:
    """Settings of a network that follows one which was given up.

    Noise drawn anew at every step may never reach what takes many steps in one direction; noise that is a function of
    the state, and stays for a rollout, pushes a lane its own way (gSDE, Raffin et al. 2022). For PPO with continuous
    actions: the rollouts of the other algorithms are too short.
    """
    able = algorithm is stable_baselines3.PPO and isinstance(env.action_space, spaces.Box)
    if not able or spec.design.preset == "paper":
        return settings
    return replace(settings, hyperparameters={"use_sde": True} | settings.hyperparameters)


def planned_steps(settings: TrainSettings) -> int:
    """Virtual steps of a training. Raises ValueError where they exceed the cap, or for an unknown algorithm.

    CMA-ES has no cap: it learns from whole episodes and takes far more steps, each far cheaper.
    """
    if settings.algorithm.upper() == EVOLUTION:
        return settings.total_steps or EVOLUTION_STEPS
    algorithm = algorithm_by_name(settings.algorithm)
    suggested = ON_POLICY_STEPS if issubclass(algorithm, OnPolicyAlgorithm) else OFF_POLICY_STEPS
    total = suggested if settings.total_steps is None else settings.total_steps
    if not 1 <= total <= MAX_STEPS:
        raise ValueError(f"virtual steps: expected 1 to {MAX_STEPS}, got {total}")
    return total


def _whole_rollouts(learner: BaseAlgorithm, total: int) -> int:
    """The steps of as many whole rollouts as the total allows, at least one: Stable-Baselines3 would round up."""
    rollout = learner.n_envs * (learner.n_steps if isinstance(learner, OnPolicyAlgorithm) else 1)
    return max(total // rollout, 1) * rollout


__all__ = ["TrainProgress", "TrainResult", "TrainSettings", "TrainingInterrupted", "algorithm_by_name", "train"]
