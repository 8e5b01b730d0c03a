"""Text and JSON about where real steps and the model disagree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from surrogym_client.evaluation.comparing import Disagreement, Disagreements
    from surrogym_client.evaluation.evaluator import Evaluation
    from surrogym_client.policies.evidence import Promise
    from surrogym_shared.spec import EnvironmentSpec


def left(promise: Promise | None, result: Evaluation) -> bool:
    """Whether the mean return lies outside the promise's interval."""
    return promise is not None and not promise.low <= result.returns.mean() <= promise.high


def differ_from(
    surrogate: str | None, server: str | None, token: str | None, result: Evaluation, first_seed: int, *, quiet: bool
) -> Differing | None:
    """Compare the real steps of the episodes with the surrogate's model; None if that is not possible."""
    from surrogym_client.cli.options import connect
    from surrogym_client.errors import SurrogymClientError
    from surrogym_client.evaluation.comparing import compared, disagreements, steps_of
    from surrogym_shared.terminal import say

    if surrogate is None:
        return None
    try:
        with connect(server, token) as api:
            view = api.surrogate(surrogate)
            if view.fidelity is None or result.trace.coordinates.shape[1] != len(view.spec.coordinates):
                return None
            steps = steps_of(result.traces)
            return Differing(disagreements(steps, compared(api, view.spec, view, steps)), first_seed)
    except SurrogymClientError as error:
        say(f"not compared with the model of {surrogate!r}: {error}", quiet=quiet)
        return None


@dataclass(frozen=True)
class Differing:
    """Steps at which reality and the model disagree, for episodes whose reset seeds begin at ``first_seed``."""

    found: Disagreements
    first_seed: int

    def in_words(self, spec: EnvironmentSpec | None) -> list[str]:
        """Return one line about all steps, one for each of the worst episodes, and one for each of the worst steps."""
        from surrogym_client.evaluation.comparing import SHOWN

        found = self.found
        if not found.found:
            return [f"none of {found.compared} real steps differs from the model by more than the model's uncertainty"]
        lines = [
            f"{len(found.found)} of {found.compared} real steps differ from the model by more than the model's "
            "uncertainty"
        ]
        for episode, count in list(found.by_episode().items())[:SHOWN]:
            paid = found.missing.get(episode, 0.0)
            lines.append(
                f"  episode of seed {self.first_seed + episode}: {count} such steps; its compared steps earned "
                f"{paid:+.4g} compared with the prediction"
            )
        names = () if spec is None else spec.coordinate_names
        return [*lines, *(f"  {self._at(one, names)}" for one in found.found[:SHOWN])]

    def as_json(self) -> dict[str, Any]:
        """Return all disagreements as JSON."""
        counts = self.found.by_episode()
        return {
            "compared": self.found.compared,
            "episodes": [
                {"seed": self.first_seed + episode, "steps": counts.get(episode, 0), "missing_reward": missing}
                for episode, missing in self.found.missing.items()
            ],
            "steps": [
                {
                    "seed": self.first_seed + one.step.episode,
                    "step": one.step.number,
                    "coordinates": list(one.step.coordinates),
                    "action": list(one.step.action),
                    "output": one.output,
                    "error": one.error,
                    "claimed": one.claimed,
                }
                for one in self.found.found
            ],
        }

    def _at(self, one: Disagreement, names: Sequence[str]) -> str:
        count = len(one.step.coordinates)
        known = names if len(names) == count else [f"q{i}" for i in range(count)]
        state = ", ".join(f"{name} {value:.4g}" for name, value in zip(known, one.step.coordinates, strict=True))
        return (
            f"seed {self.first_seed + one.step.episode}, step {one.step.number}, at {state}: {one.output} is "
            f"{one.error:+.3g} off the prediction, whose deviation is {one.claimed:.3g}"
        )
