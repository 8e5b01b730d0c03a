"""The closed loop: train a little, see where the policy goes, query there, refit, train on from the policy one has."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from surrogym_client.sb3 import SurrogateVecEnv
from surrogym_client.surrogates.waiting import wait_for_design
from surrogym_client.training.candidates import Candidates
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


@dataclass
class ClosedLoop:
    """Learn a policy, with rounds of queries where it goes until that is known, or the design is ready.

    Each round submits the states that the policy visits from the declared starts, as a checkpoint of its own, so the
    same seeds ask the same queries. Where the model is as sure over these states as the design wants it over the whole
    range, no more queries follow. The rounds move lanes by the mean: their policies go where the model promises most.
    The settings of the last training are ``chosen_for`` the phase that the design has then. Only the last training may
    be prolonged: the next round makes up for what a round's policy lacks.

    Attributes:
        api: the server.
        name: of the surrogate.
        port: the surrogate.
        out: where the policy goes, after every round.
        settings: of each training.
        rounds: how many rounds, of how many queries.
        progress: called after every rollout, with steps summed over the rounds.
        waiting: called with every look at a round's queries, while a sampler answers them.
        trained: the trainings so far.
        candidates: the policies that they left.
    """

    api: Api
    name: str
    port: SurrogatePort
    out: Path
    settings: TrainSettings
    rounds: LoopSettings
    progress: Callable[[TrainProgress], None] | None = None
    waiting: Callable[[SurrogateView], None] | None = None
    trained: list[TrainResult] = field(default_factory=list, init=False)
    candidates: Candidates = field(default_factory=Candidates)
    _visited: int = field(default=0, init=False)  # virtual steps beside the trainings
    _known: list[float | None] = field(default_factory=list, init=False)  # confidence where each round's policy went
    _region_known: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        algorithm = self.settings.algorithm
        if not search_for(self.settings).resumable:
            raise ValueError(f"{algorithm} can't start from a policy: expected no rounds, or another algorithm")
        self._whole, self._part = shares(self.settings, self.rounds.rounds)
        self._prolong = is_prolonged(self.settings, self.port.spec())

    def train(self) -> TrainResult:
        """Run the rounds and the last training.

        Raises:
            DesignUnfinished: the queries of a round were not answered in time.
            TrainingInterrupted: Ctrl-C came when there was a policy already.
            ValueError, SurrogymClientError: as ``train``.
        """
        try:
            for _ in range(self.rounds.rounds):
                if not self.round():
                    break
            self.last()
        except TrainingInterrupted as interruption:
            self.trained.append(interruption.result)
            raise TrainingInterrupted(self.result()) from None
        except KeyboardInterrupt:
            if self.trained:
                raise TrainingInterrupted(self.result()) from None
            raise
        return self.result()

    def round(self) -> bool:
        """Train a little, see where the policy goes, and query there; whether another round may follow."""
        view = self.api.surrogate(self.name)
        if view.phase == "ready":
            return False
        self._learn(self._part, self._whole, replace(self.settings, prolong=False))
        checkpoint = f"seed {self.settings.seed}, round {view.round}"
        steps, index = visit(self.port, self.trained[-1], self.settings, checkpoint)
        self._visited += steps
        self._known.append(index)
        self._region_known = index is not None and index >= view.target
        if self._region_known:
            return False
        self.api.improve(self.name, self.rounds.queries, checkpoint=checkpoint)
        patience = self.rounds.patience_seconds
        wait_for_design(self.api, self.name, patience, self.waiting, after_round=view.round)
        return True

    def last(self) -> None:
        """Train the policy that is used, by what the design came to."""
        settings, taken = self.settings, self._steps
        left = self._whole - taken
        left = max(left if settings.total_steps else min(planned_steps(settings), left), 1)
        last = _for_use(self.api.surrogate(self.name), settings, region_known=self._region_known)
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
            now = replace(now, start_from=self.out, trust_policy=False)
        known = self._known[-1] if self._known else None
        progress = _shifted(self.progress, self._steps + self._visited, whole, known)
        self.trained.append(train(self.port, self.out, now, progress))
        self.candidates.keep(self.trained[-1])


def _for_use(view: SurrogateView, settings: TrainSettings, *, region_known: bool) -> TrainSettings:
    """Settings of the last training, whose policy is used. It goes on from the policy whose region is known; where none
    is, it begins anew by draws, as a network that has learned from wrong models stays with what these taught it."""
    last = chosen_for(view, settings, by_mean=search_for(settings).by_mean)
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
