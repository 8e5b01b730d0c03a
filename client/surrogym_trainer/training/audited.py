"""Training with an audit of the policy; it continues if the audit fails or lowers the promise clearly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from surrogym_client.surrogates.waiting import wait_for_design
from surrogym_client.transport.api import Api
from surrogym_shared.port import SurrogatePort
from surrogym_shared.wire import SurrogateView
from surrogym_trainer.evaluation.audit import AUDIT_STEPS, UNSURE, disappointed, wider
from surrogym_trainer.policies.evidence import Audit
from surrogym_trainer.policies.files import load_policy
from surrogym_trainer.policies.integrals import with_integrals
from surrogym_trainer.training.closed_loop import Candidates, ClosedLoop, LoopSettings, visit
from surrogym_trainer.training.handover import MOST_AUDITS, AuditSettings, Handover, Subject, hand_over
from surrogym_trainer.training.search import PLANNING, search_for, with_algorithm
from surrogym_trainer.training.settings import (
    TrainingInterrupted,
    TrainProgress,
    TrainResult,
    TrainSettings,
    after,
    chosen_for,
    prolongs,
    summed,
)
from surrogym_trainer.training.trainer import train
from surrogym_trainer.training.trials import Trials, allows_trials, is_waiting_for_trials


@dataclass
class AuditedTraining:
    """Train a policy, audit it, and hand it over.

    After each audit, one of these things happens.

    - If the audit found that the machine is not as declared, the policy is handed over: another audit might not notice.
    - If the audit failed otherwise, real steps are taken in states that the policy visits, as far as the budget or
      unused rounds of the closed loop allow. Then the training continues, and the policy is audited again.
    - The same happens after a passed audit if a round of the closed loop is unused, and either the promised interval is
      wide or the model, which has learned from the audit, is no longer certain in these states.
    - The training also continues if the promise after the audit is clearly lower than the one before it, or than the
      imagined return of the training, unless the user limited the virtual steps. This takes no step of the budget.
    - In all other cases the policy is handed over, even if the audit failed.

    Attributes:
        api: the connection to the server.
        name: name of the surrogate.
        port: the interface of the surrogate.
        out: file to write the policy to.
        settings: settings of each training.
        rounds: settings of the closed loop; None trains without one.
        audit: settings of the audit; None takes no audit.
        progress: called after every rollout.
        waiting: called each time the surrogate is polled, while a sampler answers queries.
        saying: called with a few words before what takes no virtual step of a training, but may take minutes.
    """

    api: Api
    name: str
    port: SurrogatePort
    out: Path
    settings: TrainSettings
    rounds: LoopSettings | None = None
    audit: AuditSettings | None = None
    progress: Callable[[TrainProgress], None] | None = None
    waiting: Callable[[SurrogateView], None] | None = None
    saying: Callable[[str], None] = lambda _: None
    candidates: Candidates = field(default_factory=Candidates, init=False)
    # Number of rounds (train a policy, then query where it goes) that took no real step.
    _unspent: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self.port = with_integrals(self.port, self.settings.integral, self.settings.set_points)

    def train(self) -> tuple[TrainResult, Handover]:
        """Train and audit, and train further if the audit fails or lowers the promise clearly.

        Returns:
            The result of the training, and the promise with its audit.

        Raises:
            DesignUnfinished: queries were not answered in time.
            TrainingInterrupted: Ctrl-C was pressed when there was a policy already.
            ValueError: the settings don't fit the search.
            SurrogymClientError: the server can't be reached, or refuses a request.
        """
        result, failed = self._first(), False
        self.candidates.keep(result)
        try:
            for number in range(1, MOST_AUDITS + 1):
                taken = self.api.surrogate(self.name).ledger.total
                handover = hand_over(self._subject(result), self.audit, self.waiting)
                if failed and handover.audit is None:  # the next audit was not possible: a ready design is not enough
                    reason = f"the audit before failed, and the policy trained since has none: {handover.reason}"
                    handover = replace(handover, trusted=False, reason=reason)
                failed = handover.audit is not None and not handover.audit.passed
                if number == MOST_AUDITS or not self._to_be_trained_on(handover.audit, result, taken, number):
                    break
                result = self._train_on(result)
        except TrainingInterrupted:
            raise
        except KeyboardInterrupt:
            raise TrainingInterrupted(result) from None
        return result, handover

    def _first(self) -> TrainResult:
        rounds, inputs = self.rounds, (self.api, self.name, self.port, self.out, self.settings)
        tries = rounds is not None and allows_trials(self.port.spec(), self.settings)
        if rounds and tries and self._may_try(rounds):
            return Trials(*inputs, rounds, self.progress, self.waiting, self.candidates).train()
        if rounds is None or not rounds.queries:
            return train(self.port, self.out, self._chosen, self.progress)
        loop = ClosedLoop(*inputs, rounds, self.progress, self.waiting, self.candidates)
        result = loop.train()
        self._unspent = loop.unspent
        return self._best(result)

    def _may_try(self, rounds: LoopSettings) -> bool:
        """Whether policies try episodes: with a number of real steps, the rounds of a ready design take none."""
        if rounds.queries:
            return self.api.surrogate(self.name).phase != "ready"
        return is_waiting_for_trials(self.api, self.name)

    def _best(self, result: TrainResult) -> TrainResult:
        """Return the result whose policy earns most in the latest model: that of the last training, or of an earlier
        one."""
        return self.candidates.best(self.port, result, self._chosen)

    @property
    def _chosen(self) -> TrainSettings:
        settings = with_algorithm(self.settings, self.port.spec())
        return chosen_for(self.api.surrogate(self.name), settings)

    def _subject(self, result: TrainResult) -> Subject:
        predict, settings = load_policy(result.path, result.algorithm), self.settings
        session = chosen_for(self.api.surrogate(self.name), settings).judging
        usual = {*settings.hyperparameters} <= {"horizon"} and not settings.set_points
        plans = result.algorithm == PLANNING and usual
        rest = dict(session), result.untrained, settings.seed, plans, self.saying
        return Subject(self.api, self.name, self.port, predict, *rest)

    def _to_be_trained_on(self, audit: Audit | None, result: TrainResult, taken: int, number: int) -> bool:
        if audit is None or audit.undeclared:
            return False
        needed = not audit.passed or (self._unspent > 0 and wider(audit.after, UNSURE, result.untrained))
        if (needed or self._unspent) and self._asked_more(result, taken, number, needed=needed):
            return True
        longer = prolongs(self.settings, self.port.spec())
        return longer and disappointed(audit, result.untrained, result.imagined_return)

    def _asked_more(self, result: TrainResult, taken: int, number: int, *, needed: bool) -> bool:
        """Take the remaining steps of the budget, or an unused round of the closed loop, in states that the policy
        visits.

        If ``needed`` is false, the steps are only taken if the model is not certain in these states. An unused round
        may raise the budget, which needs a token of the role admin. Returns whether more than ``taken`` real steps have
        been counted by now. ``number`` counts the audits; it is a part of the name under which the visited states are
        submitted.
        """
        view = self.api.surrogate(self.name)
        if not needed and view.phase == "ready" and (view.confidence_index or 0.0) >= view.target:
            return False
        round_ = (self.rounds and self.rounds.queries) or AUDIT_STEPS
        left = round_ if self._unspent and self.api.access().role == "admin" else view.budget_left
        wanted = min(round_, left)
        if wanted > 0:
            checkpoint = f"seed {self.settings.seed}, audit {number}, round {view.round}"
            _, index = visit(self.port, result, self.settings, checkpoint)
            if not needed and (index is None or index >= view.target):
                return False
            self._unspent = max(self._unspent - 1, 0)
            self.api.improve(self.name, wanted, checkpoint=checkpoint)
            patience = LoopSettings(wanted).patience_seconds
            view = wait_for_design(self.api, self.name, patience, self.waiting, after_round=view.round)
        return view.ledger.total > taken

    def _train_on(self, result: TrainResult) -> TrainResult:
        """Train further, from the current policy, in the model that includes the audit's samples."""
        now = self._chosen
        if search_for(now).resumable:
            now = replace(now, start_from=self.out, trust_policy=False)
        try:
            later = train(self.port, self.out, now, self._shifted(result.virtual_steps))
        except TrainingInterrupted as interruption:
            cut_off = _joined(result, interruption.result)
            raise self.candidates.after_ctrl_c(self.port, cut_off, now) from None
        self.candidates.keep(later)
        return self._best(_joined(result, later))

    def _shifted(self, done: int) -> Callable[[TrainProgress], None] | None:
        """Return a function that reports the progress of a training that follows ``done`` virtual steps of earlier
        trainings; None if ``progress`` is None."""
        progress = self.progress
        return None if progress is None else lambda now: progress(after(now, done))


def _joined(before: TrainResult, after: TrainResult) -> TrainResult:
    """Return the result of the later training, with the virtual steps and seconds of both trainings."""
    return replace(summed(after, (before, after)), visited_confidence=before.visited_confidence)
