"""The closed loop: train a little, see where the policy goes, query there, refit, train on from the policy one has."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from surrogym_client.sb3 import SurrogateVecEnv
from surrogym_client.surrogates.waiting import wait_for_design
from surrogym_client.training.search import is_prolonged, planned_steps, search_for
from surrogym_client.training.settings import (
    SUGGESTED_STEPS,
    TrainingInterrupted,
    TrainProgress,
    TrainResult,
    TrainSettings,
    chosen_for,
)
from surrogym_client.training.trainer import train
from surrogym_client.transport.api import Api
from surrogym_shared.port import SurrogatePort
from surrogym_shared.wire import SurrogateView

ROUND_SHARE = 0.25  # of a whole training, in each round before the last
VISIT_LANES = 32
VISIT_STEPS = 1_000  # where the specification has no time limit


@dataclass(frozen=True)
class ImproveSettings:
    """How often to close the loop. No round follows once the design is ready, or once the confidence index where the
    policy goes has the design's target."""

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
    waiting: Callable[[SurrogateView], None] | None = None,
) -> TrainResult:
    """Learn a policy, with rounds of queries where it goes until that is known, or the design is ready.

    Each round submits the states that the policy visits from the declared starts, as a checkpoint of its own, so the
    same seeds ask the same queries. Where the model is as sure over these states as the design wants it over the whole
    range, nothing more is asked. The rounds move lanes by the mean: their policies go where the model promises most.
    The last training is ``chosen_for`` what the design came to. It alone is prolonged: what a round's policy lacks, the
    next has.

    Args:
        api: the server.
        name: of the surrogate.
        port: the surrogate.
        out: where the policy goes, after every round.
        settings: of each training.
        improve: of the rounds.
        progress: called after every rollout, with steps summed over the rounds.
        waiting: called with every look at a round's queries, while a sampler answers them.

    Raises:
        DesignUnfinished: the queries of a round were not answered in time.
        TrainingInterrupted: Ctrl-C came when there was a policy already.
        ValueError, SurrogymClientError: as ``train``.
    """
    rounds: list[TrainResult] = []
    visited, known, region_known = 0, list[float | None](), False
    whole, part = shares(settings, improve.rounds)
    prolong = is_prolonged(settings, port.spec())

    def learn(steps: int, whole: int, settings: TrainSettings) -> None:
        now = replace(settings, total_steps=steps)
        if rounds:
            now = replace(now, start_from=out, trust_policy=False)
        rounds.append(
            train(port, out, now, _shifted(progress, _steps(rounds) + visited, whole, known[-1] if known else None))
        )

    try:
        for _ in range(improve.rounds):
            view = api.surrogate(name)
            if view.phase == "ready":
                break
            learn(part, whole, replace(settings, prolong=False))
            checkpoint = f"seed {settings.seed}, round {view.round}"
            steps, index = visit(port, rounds[-1], settings, checkpoint)
            visited, known = visited + steps, [*known, index]
            region_known = index is not None and index >= view.target
            if region_known:
                break
            api.improve(name, improve.queries, checkpoint=checkpoint)
            wait_for_design(api, name, improve.patience_seconds, waiting, after_round=view.round)
        left = whole - _steps(rounds)
        left = max(left if settings.total_steps else min(planned_steps(settings), left), 1)
        last = replace(_for_use(api.surrogate(name), settings, region_known=region_known), prolong=prolong)
        learn(left, _steps(rounds) + visited + left, last)
    except TrainingInterrupted as interruption:
        raise TrainingInterrupted(_together([*rounds, interruption.result], visited, known)) from None
    except KeyboardInterrupt:
        if rounds:
            raise TrainingInterrupted(_together(rounds, visited, known)) from None
        raise
    return _together(rounds, visited, known)


def _for_use(view: SurrogateView, settings: TrainSettings, *, region_known: bool) -> TrainSettings:
    """Settings of the last training, whose policy is used. It goes on from the policy whose region is known; where none
    is, it begins anew by draws, as a network that has learned from wrong models stays with what these taught it."""
    last = chosen_for(view, settings)
    anew = last is not settings and settings.start_from is None and not region_known
    return replace(last, anew=anew)


def _steps(rounds: Sequence[TrainResult]) -> int:
    return sum(result.virtual_steps for result in rounds)


def _together(rounds: Sequence[TrainResult], visited: int, known: Sequence[float | None]) -> TrainResult:
    """The last round's result, with what all of them took; ``visited`` are virtual steps beside the trainings."""
    return replace(
        rounds[-1],
        virtual_steps=_steps(rounds) + visited,
        seconds=sum(r.seconds for r in rounds),
        lost_episodes=sum(r.lost_episodes for r in rounds),
        visited_confidence=tuple(known),
    )


def shares(settings: TrainSettings, rounds: int) -> tuple[int, int]:
    """Virtual steps of the whole training, all rounds included, and of each round; visits come on top.

    What was asked for bounds the whole; what is suggested is the last training's, and rounds come on top, up to the
    paper's cap. A round has the same share of the last training either way.
    """
    planned, share = planned_steps(settings), min(ROUND_SHARE, 1 / (rounds + 1))
    if settings.total_steps is not None:
        return planned, max(1, int(planned * share / (1 + rounds * share)))
    part = max(1, int(share * planned))
    return min(planned + rounds * part, SUGGESTED_STEPS), part


def visit(
    port: SurrogatePort, learned: TrainResult, settings: TrainSettings, checkpoint: str
) -> tuple[int, float | None]:
    """Let the policy of a round run from the declared starts and submit where it went. Returns how many virtual steps
    that took, and the confidence index there."""
    spec = port.spec()
    act = search_for(settings).explorer(learned.path, learned.algorithm, VISIT_LANES)
    options = {**settings.session, "occupancy": True}
    env = SurrogateVecEnv.from_port(port, VISIT_LANES, seed=settings.seed, **options)
    steps = min(spec.time_limit or VISIT_STEPS, VISIT_STEPS)
    try:
        observation: Any = env.reset()
        for _ in range(steps):
            observation, _, _, _ = env.step(act(observation))
        submitted = env.submit_occupancy(checkpoint)
    finally:
        env.close()
    return steps * VISIT_LANES, submitted.confidence_index


def _shifted(
    progress: Callable[[TrainProgress], None] | None, done: int, total: int, known: float | None
) -> Callable[[TrainProgress], None] | None:
    if progress is None:
        return None
    return lambda now: progress(
        replace(now, steps=done + now.steps, total_steps=max(total, done + now.total_steps), visited_confidence=known)
    )
