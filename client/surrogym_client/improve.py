"""The closed loop: train a little, see where the policy goes, query there, refit, train on from the policy one has."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from surrogym_client.api import Api
from surrogym_client.evaluate import Predict
from surrogym_client.sb3 import SurrogateVecEnv
from surrogym_client.train import (
    MAX_STEPS,
    TrainProgress,
    TrainResult,
    TrainSettings,
    algorithm_by_name,
    planned_steps,
    train,
)
from surrogym_client.waiting import wait_for_design
from surrogym_shared.network import Network
from surrogym_shared.port import SurrogatePort

ROUND_SHARE = 0.25  # of a whole training, in each round before the last
VISIT_LANES = 32
VISIT_STEPS = 1_000  # where the specification has no time limit


@dataclass(frozen=True)
class ImproveSettings:
    """How often to close the loop. A design that is ready needs no further round."""

    queries: int  # real steps a round
    rounds: int = 3
    patience_seconds: float = 3_600.0  # for the sampler to answer one round


def train_and_improve(
    api: Api,
    name: str,
    port: SurrogatePort,
    out: Path,
    settings: TrainSettings,
    improve: ImproveSettings,
    progress: Callable[[TrainProgress], None] | None = None,
) -> TrainResult:
    """Learn a policy, with rounds of queries where it goes as long as the design is not ready.

    Each round submits the states that the policy visits from the declared starts, as a checkpoint of its own, so the
    same seeds ask the same queries.

    Args:
        api: the server.
        name: of the surrogate.
        port: the surrogate.
        out: where the policy goes, after every round.
        settings: of each training.
        improve: of the rounds.
        progress: called after every rollout, with steps summed over the rounds.

    Raises:
        DesignUnfinished: the queries of a round were not answered in time.
        ValueError, SurrogymClientError: as ``train``.
    """
    whole, part = shares(settings, improve.rounds)
    trained, visited, seconds, lost, policy = 0, 0, 0.0, 0, settings.start_from
    for _ in range(improve.rounds):
        view = api.surrogate(name)
        if view.phase == "ready":
            break
        now = replace(settings, total_steps=part, start_from=policy)
        result = train(port, out, now, _shifted(progress, trained + visited, whole))
        trained, seconds, policy = trained + result.virtual_steps, seconds + result.seconds, out
        lost += result.lost_episodes
        checkpoint = f"seed {settings.seed}, round {view.round}"
        visited += visit(port, out, settings, checkpoint)
        api.improve(name, improve.queries, checkpoint=checkpoint)
        wait_for_design(api, name, improve.patience_seconds, after_round=view.round)
    left = whole - trained if settings.total_steps else min(planned_steps(settings), whole - trained)
    last = replace(settings, total_steps=max(left, 1), start_from=policy)
    result = train(port, out, last, _shifted(progress, trained + visited, trained + visited + left))
    return replace(
        result,
        virtual_steps=trained + visited + result.virtual_steps,
        seconds=seconds + result.seconds,
        lost_episodes=lost + result.lost_episodes,
    )


def shares(settings: TrainSettings, rounds: int) -> tuple[int, int]:
    """Virtual steps of the whole training, all rounds included, and of each round; visits come on top.

    What was asked for bounds the whole; what is suggested is added to, up to the cap.
    """
    planned = planned_steps(settings)
    part = max(1, int(min(ROUND_SHARE, 1 / (rounds + 1)) * planned))
    return planned if settings.total_steps is not None else min(planned + rounds * part, MAX_STEPS), part


def visit(port: SurrogatePort, policy: Path, settings: TrainSettings, checkpoint: str) -> int:
    """Let a policy run from the declared starts and submit where it went; the number of virtual steps that took."""
    spec = port.spec()
    act = explorer(policy, settings.algorithm)
    options = {**settings.session, "occupancy": True}
    env = SurrogateVecEnv.from_port(port, VISIT_LANES, seed=settings.seed, **options)
    steps = min(spec.time_limit or VISIT_STEPS, VISIT_STEPS)
    try:
        observation: Any = env.reset()
        for _ in range(steps):
            observation, _, _, _ = env.step(act(observation))
        env.submit_occupancy(checkpoint)
    finally:
        env.close()
    return steps * VISIT_LANES


def explorer(policy: Path, algorithm: str) -> Predict:
    """The policy as it explores while it learns; a network of arrays has one action for each observation."""
    if Network.is_at(policy):
        return Network.load(policy)
    learner = algorithm_by_name(algorithm).load(policy, device="cpu")
    return lambda observation: learner.predict(observation, deterministic=False)[0]


def _shifted(
    progress: Callable[[TrainProgress], None] | None, done: int, total: int
) -> Callable[[TrainProgress], None] | None:
    if progress is None:
        return None
    return lambda now: progress(replace(now, steps=done + now.steps, total_steps=max(total, done + now.steps)))
