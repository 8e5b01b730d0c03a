"""Runs of a study: a surrogate that is learned in an arm's way, or the policy search in the original environment."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from surrogym.demo.judging import Judgement, episodes_of
from surrogym.demo.learning import Learned, SurrogateRun
from surrogym.demo.processes import Children
from surrogym_lab.original_port import OriginalPort
from surrogym_lab.settings import StudySettings
from surrogym_shared.terminal import progress
from surrogym_trainer.policies.card import PolicyCard, write_card
from surrogym_trainer.training import TrainProgress, TrainSettings, train
from surrogym_trainer.training.words import words_of


def begin(settings: StudySettings, folder: Path, children: Children, *, quiet: bool) -> SurrogateRun:
    """Begin the run of an arm."""
    if settings.way.original:
        return OriginalRun(settings, folder, quiet=quiet)
    if settings.way.closed_loop:
        return SurrogateRun(settings, folder, children, quiet=quiet)
    return DesignFirstRun(settings, folder, children, quiet=quiet)


class DesignFirstRun(SurrogateRun):
    """The whole budget is spent by the design, before the training."""

    def learn(self) -> Learned:
        self._register()
        with self._timed("design"):
            self._design()
        with self._timed("train"):
            self._train(self._employ_trainer())
        return self._learned()

    def _design(self) -> None:
        """Add queries one by one if the design was ready before its budget was spent."""
        name, budget, before = self._settings.task, self._settings.real_steps, -1
        with progress("design", quiet=self._quiet) as update:
            view = self._wait_for_design(update)
            while before < view.ledger.total < budget:
                before = view.ledger.total
                self._api.improve(name, 1)
                view = self._wait_for_design(update, after_round=view.round)


class OriginalRun(SurrogateRun):
    """The default training in the original environment. Its steps are real, including those of its checks."""

    def __init__(self, settings: StudySettings, folder: Path, *, quiet: bool) -> None:
        self._settings = settings
        self._folder = folder
        self._quiet = quiet

    def learn(self) -> Learned:
        """Train, and count the steps of the original environment."""
        asked = self._settings
        chosen = TrainSettings(asked.search, asked.virtual_steps, seed=asked.seed, prolong=asked.prolong)
        port = OriginalPort(self._settings.judged_by(), episodes_of(self._settings))
        with progress("train", quiet=self._quiet) as update:

            def look(now: TrainProgress) -> None:
                update(now.steps / now.total_steps, words_of(asdict(now)))

            result = train(port, self._policy, chosen, look)
        write_card(
            self._policy,
            PolicyCard(
                algorithm=result.algorithm,
                spec=port.spec(),
                seed=chosen.seed,
                virtual_steps=0,
                imagined_return=None,
                networks=result.networks,
                settings=result.settings,
            ),
        )
        steps = {"initial": 0, "adaptive": 0, "total": port.steps, "unresolved": 0}
        return Learned(self._policy, steps, {"train": result.seconds})

    def keep(self, judgement: Judgement) -> None:
        """Nothing to store: there is no ledger and no design."""

    def linger(self) -> None:
        """Nothing to leave running."""
