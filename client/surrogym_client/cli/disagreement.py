"""Where real steps and the model disagree, as lines for a person and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from surrogym_client.evaluation.comparing import Disagreement, Disagreements
    from surrogym_client.evaluation.evaluator import Evaluation
    from surrogym_client.policies.evidence import Promise
    from surrogym_shared.spec import EnvironmentSpec


def left(promise: Promise | None, result: Evaluation) -> bool:
    """Whether the mean return lies outside of the promise's interval, on either side."""
    return promise is not None and not promise.low <= result.returns.mean() <= promise.high


def differ_from(
    surrogate: str | None, server: str | None, token: str | None, result: Evaluation, *, quiet: bool
) -> Disagreements | None:
    """Real steps of the episodes held against the surrogate's model; None where that can't be asked."""
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
            return disagreements(steps, compared(api, view.spec, view, steps))
    except SurrogymClientError as error:
        say(f"not held against the model of {surrogate!r}: {error}", quiet=quiet)
        return None


def disagreements_in_words(found: Disagreements, spec: EnvironmentSpec | None, first_seed: int) -> list[str]:
    """A line for all steps, one for each of the worst episodes, and one for each of the worst steps."""
    from surrogym_client.evaluation.comparing import SHOWN

    names = () if spec is None else spec.coordinate_names
    if not found.found:
        return [f"none of {found.compared} real steps differs from the model by more than it claims"]
    lines = [f"{len(found.found)} of {found.compared} real steps differ from the model by more than it claims"]
    for episode, count in list(found.by_episode().items())[:SHOWN]:
        paid = found.missing.get(episode, 0.0)
        lines.append(
            f"  episode of seed {first_seed + episode}: {count} such steps; its compared steps paid {paid:+.4g} beside "
            "the prediction"
        )
    return [*lines, *(f"  {_at(one, names, first_seed)}" for one in found.found[:SHOWN])]


def disagreements_as_json(found: Disagreements, first_seed: int) -> dict[str, Any]:
    """All of it."""
    return {
        "compared": found.compared,
        "episodes": [
            {"seed": first_seed + episode, "steps": found.by_episode().get(episode, 0), "missing_reward": missing}
            for episode, missing in found.missing.items()
        ],
        "steps": [
            {
                "seed": first_seed + one.step.episode,
                "step": one.step.number,
                "coordinates": list(one.step.coordinates),
                "action": list(one.step.action),
                "output": one.output,
                "error": one.error,
                "claimed": one.claimed,
            }
            for one in found.found
        ],
    }


def _at(one: Disagreement, names: Sequence[str], first_seed: int) -> str:
    known = names if len(names) == len(one.step.coordinates) else [f"q{i}" for i in range(len(one.step.coordinates))]
    state = ", ".join(f"{name} {value:.4g}" for name, value in zip(known, one.step.coordinates, strict=True))
    return (
        f"seed {first_seed + one.step.episode}, step {one.step.number}, at {state}: {one.output} is {one.error:+.3g} "
        f"beside the prediction, where {one.claimed:.3g} was claimed"
    )
