"""Conversion of real episodes to the form that the server stores: every return, and a few traces (episodes step by
step).

One of the traces is the paired one: it has the same start for every controller that is compared.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surrogym_shared import wire
from surrogym_shared.spec import EnvironmentSpec
from surrogym_trainer.evaluation.evaluator import Evaluation, EvaluationSettings, Trace

MAX_POINTS = 2_000  # largest number of steps in a stored trace; longer traces are cut
MAX_NUMBERS = 30_000  # largest number of numbers in a trace, so that four traces fit in a request of 4 MiB


def as_reported(
    result: Evaluation,
    settings: EvaluationSettings,
    key: str,
    *,
    environment: str = "",
    trained_for: EnvironmentSpec | None = None,
    controller: wire.Controller = "policy",
    paired: int = 0,
) -> wire.AddEvaluation:
    """Convert an evaluation to the request that stores it.

    Args:
        result: the episodes.
        settings: starts, perturbation and exploration of the episodes.
        key: idempotency key, so that the same evaluation is stored once.
        environment: name of the environment in which the episodes ran; empty for the surrogate's own.
        trained_for: specification that the policy was trained for, if it is known.
        controller: kind of the controller that chose the actions.
        paired: index of the episode whose trace is compared with that of other controllers, see ``paired_start``.
    """
    shown: dict[wire.TraceRank, int] = {"paired": paired, **result.ranked()}
    return wire.AddEvaluation(
        controller=controller,
        note=_note(settings, result, trained_for),
        declared=is_promised(settings, result, trained_for),
        seeded=result.seeded,
        environment=environment,
        first_seed=settings.first_seed,
        returns=result.returns.tolist(),
        lengths=result.lengths.tolist(),
        success=None if result.success is None else result.success.tolist(),
        traces=[_trace(rank, settings.first_seed + at, result.traces[at]) for rank, at in shown.items()],
        idempotency_key=key,
    )


def is_promised(settings: EvaluationSettings, result: Evaluation, trained_for: EnvironmentSpec | None) -> bool:
    """Return whether episodes are of the kind to which a promise applies: declared starts, unchanged constants, and the
    time limit of the policy's specification."""
    return settings.declared and not result.varied and not has_other_limit(result, trained_for)


def has_other_limit(result: Evaluation, trained_for: EnvironmentSpec | None) -> bool:
    """Return whether the episodes had another time limit than the specification that the policy was trained for."""
    return trained_for is not None and result.limit != trained_for.time_limit


def paired_start(result: Evaluation, among: int) -> int:
    """Return the index of the start to compare: of the first ``among`` episodes, the one in which the policy had its
    median return."""
    order = np.argsort(result.returns[:among], kind="stable")
    return int(order[(len(order) - 1) // 2])


def words_of(settings: EvaluationSettings, varied: Sequence[str] = ()) -> str:
    """Return a description of the starts, of the environment's perturbation, and of constants that ``varied`` within an
    episode."""
    starts = "declared starts"
    if settings.wide:
        starts = "starts anywhere in the sampling range"
    elif settings.start_scale != 1:
        starts = f"starts {settings.start_scale:g} times as far apart as declared"
    machine = f", physical parameters changed by {settings.perturb:.0%}" if settings.perturb else ""
    changing = f", {', '.join(varied)} changed within episodes" if varied else ""
    random = f", actions changed at random by {settings.explore:.2g}" if settings.explore else ""
    return f"{starts}, from seed {settings.first_seed}{machine}{random}{changing}"


def _note(settings: EvaluationSettings, result: Evaluation, trained_for: EnvironmentSpec | None) -> str:
    limit = f", episodes of at most {result.limit} steps" if has_other_limit(result, trained_for) else ""
    seeds = "" if result.seeded else ", which the environment ignored"
    return f"{words_of(settings, result.varied)}{limit}{seeds}"


def _trace(rank: wire.TraceRank, seed: int, trace: Trace) -> wire.EpisodeTrace:
    numbers = np.shape(trace.coordinates)[1] + np.shape(trace.action)[1] + 1  # numbers in one step
    steps = min(len(trace.reward), MAX_POINTS, MAX_NUMBERS // numbers)
    return wire.EpisodeTrace(
        rank=rank,
        seed=seed,
        coordinates=np.asarray(trace.coordinates[: steps + 1]).tolist(),
        action=np.asarray(trace.action[:steps]).tolist(),
        reward=np.asarray(trace.reward[:steps]).tolist(),
    )
