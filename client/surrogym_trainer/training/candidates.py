"""Comparison of one training's policies in the latest model, so that the best one is handed over."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from surrogym_shared.port import SurrogatePort
from surrogym_trainer.evaluation.imagined import imagined_returns
from surrogym_trainer.policies.files import load_policy
from surrogym_trainer.policies.predict import Predict
from surrogym_trainer.training.settings import TrainResult, TrainSettings

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
        """
        others = [(result, content) for result, content in self._kept if content != Path(latest.path).read_bytes()]
        if not others:
            return latest
        path, current = Path(latest.path), Path(latest.path).read_bytes()
        earned = self._earned(port, latest, settings)
        found, kept, gain = latest, current, 0.0
        try:
            for result, content in others:
                path.write_bytes(content)
                more = self._earned(port, result, settings) - earned
                error = float(more.std(ddof=1)) / np.sqrt(len(more))
                if float(more.mean()) > max(gain, CLEARLY * error):
                    found, kept, gain = result, content, float(more.mean())
        finally:
            path.write_bytes(kept)
        if found is latest:
            return latest
        took = {name: getattr(latest, name) for name in ("virtual_steps", "seconds", "lost_episodes")}
        return replace(found, **took, visited_confidence=latest.visited_confidence)

    def _earned(self, port: SurrogatePort, result: TrainResult, settings: TrainSettings) -> np.ndarray:
        predict = self.load(Path(result.path), result.algorithm)
        return imagined_returns(port, predict, EPISODES, settings.seed, **settings.judging)
