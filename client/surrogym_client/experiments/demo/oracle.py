"""The oracle: the surrogate's policy search, run in the original environment."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from surrogym_client.experiments.demo.judging import Judgement, episodes_of
from surrogym_client.experiments.demo.learning import Learned
from surrogym_client.experiments.settings import DemoSettings
from surrogym_client.original.port import OriginalPort
from surrogym_client.policies.card import PolicyCard, write_card
from surrogym_client.training import TrainProgress, TrainSettings, train
from surrogym_client.training.words import words_of
from surrogym_shared.terminal import progress


class OriginalRun:
    """The default training in the original environment. Its steps are real, including those of its checks."""

    def __init__(self, settings: DemoSettings, folder: Path, *, quiet: bool) -> None:
        self._settings = settings
        self._policy = folder / "policy.zip"
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
