"""The closed loop: train for a while, query in states that the policy visits, fit the model again, and train further.

The policies of one training are compared in the latest model, so that the best one is handed over.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from surrogym_client.environments.lanes import Lanes, session_request
from surrogym_client.errors import SurrogymClientError
from surrogym_client.surrogates.waiting import DesignUnfinished, wait_for_design
from surrogym_client.transport.api import Api
from surrogym_shared.port import SurrogatePort
from surrogym_shared.wire import SurrogateView
from surrogym_trainer.evaluation.imagined import imagined_returns
from surrogym_trainer.policies.files import load_policy
from surrogym_trainer.policies.predict import Predict
from surrogym_trainer.training.search import is_prolonged, planned_steps, search_for, with_algorithm
from surrogym_trainer.training.settings import (
    SUGGESTED_STEPS,
    TrainingInterrupted,
    TrainProgress,
    TrainResult,
    TrainSettings,
    after,
    chosen_for,
    summed,
)
from surrogym_trainer.training.trainer import train

EPISODES = 128  # policies are compared over this number of virtual episodes, with the same starts for each policy
# an earlier policy replaces the latest one if its mean return is higher by more than this number of standard errors
CLEARLY = 2.0


@dataclass
class Candidates:
    """The final policies of the trainings so far, with the content of their files.

    Real steps between two trainings change the model. A policy that was better in an earlier model can be worse in the
    new one.
    """

    load: Callable[[Path, str], Predict] = load_policy
    _kept: list[tuple[TrainResult, bytes]] = field(default_factory=list)

    def keep(self, result: TrainResult) -> None:
        """Store a policy before the next training overwrites its file."""
        self._kept.append((result, Path(result.path).read_bytes()))

    def best(self, port: SurrogatePort, latest: TrainResult, settings: TrainSettings) -> TrainResult:
        """Return the latest result, or an earlier one whose policy earns clearly more in the current model.

        If it is an earlier one, its policy is written to the latest result's file.

        Raises:
            TrainingInterrupted: Ctrl-C was pressed; it has the best of the policies that were compared by then.
        """
        path = Path(latest.path)
        current = path.read_bytes()
        others = [(result, content) for result, content in self._kept if content != current]
        if not others:
            return latest
        found, kept, gain, interrupted = latest, current, 0.0, False
        try:
            earned = self._earned(port, latest, current, settings)
            for result, content in others:
                more = self._earned(port, result, content, settings) - earned
                error = float(more.std(ddof=1)) / np.sqrt(len(more))
                if float(more.mean()) > max(gain, CLEARLY * error):
                    found, kept, gain = result, content, float(more.mean())
        except KeyboardInterrupt:
            interrupted = True
        if found is not latest:
            path.write_bytes(kept)
            took = {name: getattr(latest, name) for name in ("virtual_steps", "seconds", "lost_episodes")}
            found = replace(found, **took, visited_confidence=latest.visited_confidence)
        if interrupted:
            raise TrainingInterrupted(found)
        return found

    def after_ctrl_c(self, port: SurrogatePort, cut_off: TrainResult, settings: TrainSettings) -> TrainingInterrupted:
        """Return the exception to raise after Ctrl-C in a training whose policy so far is ``cut_off``. It has the
        result of the best policy, whose file is in place."""
        with suppress(SurrogymClientError):  # without the surrogate, nothing can be compared
            try:
                return TrainingInterrupted(self.best(port, cut_off, settings))
            except TrainingInterrupted as again:
                return again
        return TrainingInterrupted(cut_off)

    def _earned(self, port: SurrogatePort, result: TrainResult, content: bytes, settings: TrainSettings) -> np.ndarray:
        """Return the returns (``EPISODES``,) of a policy, of which ``content`` is the file's content."""
        with TemporaryDirectory() as folder:
            file = Path(folder, Path(result.path).name)
            file.write_bytes(content)
            predict = self.load(file, result.algorithm)
        return imagined_returns(port, predict, EPISODES, settings.seed, **settings.judging)


# Each round (train a policy, then query where it goes) takes at most this share of the last training's virtual steps.
ROUND_SHARE = 0.25
VISIT_LANES = 32
# To find the states that a round's policy visits, each virtual environment takes at most this number of steps.
VISIT_STEPS = 1_000


@dataclass(frozen=True)
class LoopSettings:
    """The number of rounds of the closed loop, and of queries in each.

    The rounds end early if the design is ready, or if the confidence index over the states that the policy visits
    reaches the design's target.
    """

    queries: int  # number of real steps in one round (train a policy, then query where it goes); 0: not given
    rounds: int = 3
    # longest time in seconds to wait until samplers have taken the real steps of a round
    patience_seconds: float = 3_600.0


@dataclass
class TrainingInRounds(ABC):
    """Trainings with real steps between them, from which the model learns.

    Attributes:
        api: the connection to the server.
        name: name of the surrogate.
        port: the interface of the surrogate.
        out: file to write the policy to, after every training.
        settings: settings of each training.
        rounds: number of rounds, and of real steps in each.
        progress: called after every rollout, with steps summed over the trainings.
        waiting: called each time the surrogate is polled, while a sampler takes a round's steps.
        candidates: policies of the trainings.
        trained: results of the trainings so far.
        best: result of the policy to hand over.
    """

    api: Api
    name: str
    port: SurrogatePort
    out: Path
    settings: TrainSettings
    rounds: LoopSettings
    progress: Callable[[TrainProgress], None] | None = None
    waiting: Callable[[SurrogateView], None] | None = None
    candidates: Candidates = field(default_factory=Candidates)
    trained: list[TrainResult] = field(default_factory=list, init=False)
    best: TrainResult | None = field(default=None, init=False)

    @abstractmethod
    def _run(self) -> None:
        """Run the rounds and the last training."""

    def train(self) -> TrainResult:
        """Return the policy to hand over, with the steps and seconds of all trainings.

        Raises:
            DesignUnfinished: no sampler took the steps of a round in time.
            TrainingInterrupted: Ctrl-C was pressed when there was a policy already.
            ValueError: the settings don't fit the search.
            SurrogymClientError: the server can't be reached, or refuses a request.
        """
        try:
            self._run()
        except TrainingInterrupted as interruption:
            self.best = interruption.result
            raise TrainingInterrupted(self.result()) from None
        except KeyboardInterrupt:
            if self.trained:
                raise TrainingInterrupted(self.result()) from None
            raise
        except DesignUnfinished as unfinished:
            if self.best is None:
                raise
            raise DesignUnfinished(f"{unfinished}; the policy so far is in {self.best.path}") from unfinished
        return self.result()

    def result(self) -> TrainResult:
        """Return the best result, with the steps and seconds of all trainings."""
        assert self.best is not None  # there is at least one training
        return summed(self.best, self.trained)

    @property
    def _steps(self) -> int:
        return sum(result.virtual_steps for result in self.trained)

    def _train(self, settings: TrainSettings, progress: Callable[[TrainProgress], None] | None) -> TrainResult:
        try:
            self.best = train(self.port, self.out, settings, progress)
        except TrainingInterrupted as interruption:
            self.trained.append(interruption.result)
            raise self.candidates.after_ctrl_c(self.port, interruption.result, settings) from None
        self.trained.append(self.best)
        self.candidates.keep(self.best)
        return self.best


@dataclass
class ClosedLoop(TrainingInRounds):
    """Train a policy in rounds, with queries in states that it visits, until the model is certain there or the design
    is ready.

    Each round submits the states that the policy visits from the declared starts, as a checkpoint that no other
    training shares. So the queries of a round depend on this training alone, and the same seeds choose the same
    queries. The rounds end once the confidence index over these states reaches the target that the design has for the
    whole range. In the rounds, virtual states follow the model's mean, so that a policy goes where the model predicts
    the highest return. The settings of the last training depend on whether the design is ready then, and on the noise
    that it has confirmed. Only the last training may be prolonged, because a later round makes up for a short earlier
    one.
    """

    # Number of virtual steps that were taken to find the states which policies visit.
    _visited: int = field(default=0, init=False)
    # for each round, the confidence index over the states that its policy visited; None if it is not known
    _known: list[float | None] = field(default_factory=list, init=False)
    _region_known: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        self.settings = with_algorithm(self.settings, self.port.spec())
        if not search_for(self.settings).resumable:
            raise ValueError(
                f"algorithm {self.settings.algorithm} can't continue the policy of the round before: train without "
                "rounds, or by another algorithm"
            )
        self._whole, self._part = shares(self.settings, self.rounds.rounds)
        self._prolong = is_prolonged(self.settings, self.port.spec())

    def _run(self) -> None:
        for _ in range(self.rounds.rounds):
            if not self.round():
                break
        self.last()

    def round(self) -> bool:
        """Run one round: train for a while, submit the visited states, and query in these states. Returns whether
        another round may follow."""
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
        """Train the policy to hand over, with settings that depend on the design's phase."""
        settings, taken = self.settings, self._steps
        left = self._whole - taken
        left = max(left if settings.total_steps else min(planned_steps(settings), left), 1)
        last = _for_use(self.api.surrogate(self.name), settings, region_known=self._region_known)
        self._learn(left, taken + self._visited + left, replace(last, prolong=self._prolong))

    def result(self) -> TrainResult:
        whole = super().result()
        steps = whole.virtual_steps + self._visited
        return replace(whole, virtual_steps=steps, visited_confidence=tuple(self._known))

    @property
    def unspent(self) -> int:
        """Number of rounds that took no real step, because the design was ready, or the model was certain in the states
        that the policy visits."""
        return self.rounds.rounds - len(self._known) + int(self._region_known)

    def _learn(self, steps: int, whole: int, settings: TrainSettings) -> None:
        now = replace(settings, total_steps=steps)
        if self.trained:
            now = replace(now, start_from=self.out, trust_policy=False)
        known = self._known[-1] if self._known else None
        self._train(now, shifted(self.progress, self._steps + self._visited, whole, known))


def _for_use(view: SurrogateView, settings: TrainSettings, *, region_known: bool) -> TrainSettings:
    """Return the settings of the last training.

    If the model is certain in the states that the last round's policy visits (``region_known``), training continues
    from that policy. Otherwise it begins with a new network and the variant with posterior samples, because a network
    that has learned from wrong models keeps what they taught it.
    """
    last = chosen_for(view, settings)
    anew = last is not settings and settings.start_from is None and not region_known
    return replace(last, anew=anew)


def shares(settings: TrainSettings, rounds: int) -> tuple[int, int]:
    """Return the virtual steps of the whole training, including all rounds, and of each round.

    Steps that collect visited states are not included. If the user requested a number of steps, it limits the whole
    training. Otherwise the last training has the number of steps that is planned for a training without rounds. The
    rounds add to it, but the sum is at most the paper's largest number of steps. In both cases each round takes
    ``ROUND_SHARE`` of the steps of the last training, or less if there are many rounds.
    """
    planned, share = planned_steps(settings), min(ROUND_SHARE, 1 / (rounds + 1))
    if settings.total_steps is not None:
        return planned, max(1, int(planned * share / (1 + rounds * share)))
    part = max(1, int(share * planned))
    return min(planned + rounds * part, SUGGESTED_STEPS), part


def visit(
    port: SurrogatePort, learned: TrainResult, settings: TrainSettings, checkpoint: str
) -> tuple[int, float | None]:
    """Run the policy of a round from the declared starts, and submit the visited states to the surrogate.

    Args:
        port: the interface of the surrogate.
        learned: result of the round's training.
        settings: settings of the training.
        checkpoint: name under which the states are submitted.

    Returns:
        The number of virtual steps that this took, and the confidence index over the visited states.
    """
    spec = port.spec()
    act = search_for(with_algorithm(settings, spec)).explorer(learned.path, learned.algorithm, VISIT_LANES)
    options = {**settings.session, "occupancy": True, "seed": settings.seed}
    lanes = Lanes(port, session_request(VISIT_LANES, "same_step", options))
    steps = min(spec.time_limit or VISIT_STEPS, VISIT_STEPS)
    try:
        observation = lanes.reset().observation
        for _ in range(steps):
            observation = lanes.step(act(observation)).result.observation
        submitted = port.submit_occupancy(lanes.view.id, checkpoint)
    finally:
        lanes.close()
    return steps * VISIT_LANES, submitted.confidence_index


def shifted(
    progress: Callable[[TrainProgress], None] | None, done: int, total: int, known: float | None
) -> Callable[[TrainProgress], None] | None:
    """Return a function that reports the progress of a training that follows ``done`` of ``total`` virtual steps, with
    the confidence index ``known`` over visited states; None if ``progress`` is None."""
    if progress is None:
        return None
    return lambda now: progress(after(replace(now, visited_confidence=known), done, total))
