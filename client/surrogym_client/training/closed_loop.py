"""The closed loop: train a little, see where the policy goes, query there, refit, train on from the policy one has."""

from __future__ import annotations

from collections.abc import Callable
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
class LoopSettings:
    """How often to close the loop. No round follows once the design is ready, or once the confidence index where the
    policy goes has the design's target."""

    queries: int  # real steps a round
    rounds: int = 3
    patience_seconds: float = 3_600.0  # for the sampler to answer one round


def train_in_closed_loop(
    api: Api,
    name: str,
    port: SurrogatePort,
    out: Path,
    settings: TrainSettings,
    improve: LoopSettings,
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
    loop = _Loop(api, name, port, out, settings, improve, progress, waiting)
    try:
        for _ in range(improve.rounds):
            if not loop.round():
                break
        loop.last()
    except TrainingInterrupted as interruption:
        loop.trained.append(interruption.result)
        raise TrainingInterrupted(loop.result()) from None
    except KeyboardInterrupt:
        if loop.trained:
            raise TrainingInterrupted(loop.result()) from None
        raise
    return loop.result()


class _Loop:
    """The trainings so far, and what is known of where their policies went."""

    def __init__(
        self,
        api: Api,
        name: str,
        port: SurrogatePort,
        out: Path,
        settings: TrainSettings,
        improve: LoopSettings,
        progress: Callable[[TrainProgress], None] | None,
        waiting: Callable[[SurrogateView], None] | None,
    ) -> None:
        self._api, self._name, self._port, self._out = api, name, port, out
        self._settings, self._improve = settings, improve
        self._progress, self._waiting = progress, waiting
        self._whole, self._part = shares(settings, improve.rounds)
        self._prolong = is_prolonged(settings, port.spec())
        if not search_for(settings).resumable:
            raise ValueError(
                f"{settings.algorithm} can't start from a policy: expected no rounds, or another algorithm"
            )
        self._visited = 0  # virtual steps beside the trainings
        self._known: list[float | None] = []  # confidence index where the policy went, of each round
        self._region_known = False
        self.trained: list[TrainResult] = []

    def round(self) -> bool:
        """Train a little, see where the policy goes, and query there; whether another round may follow."""
        view = self._api.surrogate(self._name)
        if view.phase == "ready":
            return False
        self._learn(self._part, self._whole, replace(self._settings, prolong=False))
        checkpoint = f"seed {self._settings.seed}, round {view.round}"
        steps, index = visit(self._port, self.trained[-1], self._settings, checkpoint)
        self._visited += steps
        self._known.append(index)
        self._region_known = index is not None and index >= view.target
        if self._region_known:
            return False
        self._api.improve(self._name, self._improve.queries, checkpoint=checkpoint)
        patience = self._improve.patience_seconds
        wait_for_design(self._api, self._name, patience, self._waiting, after_round=view.round)
        return True

    def last(self) -> None:
        """Train the policy that is used, by what the design came to."""
        settings, taken = self._settings, self._steps
        left = self._whole - taken
        left = max(left if settings.total_steps else min(planned_steps(settings), left), 1)
        last = _for_use(self._api.surrogate(self._name), settings, region_known=self._region_known)
        self._learn(left, taken + self._visited + left, replace(last, prolong=self._prolong))

    def result(self) -> TrainResult:
        """The last training's result, with what all of them took."""
        return replace(
            self.trained[-1],
            virtual_steps=self._steps + self._visited,
            seconds=sum(result.seconds for result in self.trained),
            lost_episodes=sum(result.lost_episodes for result in self.trained),
            visited_confidence=tuple(self._known),
        )

    @property
    def _steps(self) -> int:
        return sum(result.virtual_steps for result in self.trained)

    def _learn(self, steps: int, whole: int, settings: TrainSettings) -> None:
        now = replace(settings, total_steps=steps)
        if self.trained:
            now = replace(now, start_from=self._out, trust_policy=False)
        known = self._known[-1] if self._known else None
        progress = _shifted(self._progress, self._steps + self._visited, whole, known)
        self.trained.append(train(self._port, self._out, now, progress))


def _for_use(view: SurrogateView, settings: TrainSettings, *, region_known: bool) -> TrainSettings:
    """Settings of the last training, whose policy is used. It goes on from the policy whose region is known; where none
    is, it begins anew by draws, as a network that has learned from wrong models stays with what these taught it."""
    last = chosen_for(view, settings)
    anew = last is not settings and settings.start_from is None and not region_known
    return replace(last, anew=anew)


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
