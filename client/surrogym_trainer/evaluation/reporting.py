"""The forms in which a server stores real episodes: every return, and a few traces (episodes step by step); and a file
that keeps real steps until a server has them.

One of the traces is the paired one: it has the same start for every controller that is compared. ``surrogym import``
reads a file of steps.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import count
from pathlib import Path

import numpy as np

from surrogym_shared import wire
from surrogym_shared.checks import MAX_MEASURED
from surrogym_shared.limits import KeptEpisodes
from surrogym_shared.logs.drafting import wrapped
from surrogym_shared.logs.writing import EVALUATED, npz_of_steps
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import NewSample
from surrogym_trainer.evaluation.comparing import StepOfEpisode
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
        limits=counts_of_limits(result.limits),
        idempotency_key=key,
    )


def counts_of_limits(kept: KeptEpisodes | None) -> wire.LimitCounts | None:
    """Return how episodes kept their limits, in the form in which a server counts it; None without limits."""
    if kept is None:
        return None
    return wire.LimitCounts(
        violations=kept.violations, fallbacks=kept.fallbacks, fallback_episodes=kept.fallback_episodes
    )


def is_promised(settings: EvaluationSettings, result: Evaluation, trained_for: EnvironmentSpec | None) -> bool:
    """Return whether episodes are of the kind to which a promise applies: they start as declared, no constant
    coordinate changed within an episode, and their time limit is that of the specification ``trained_for``."""
    return settings.declared and not result.varied and not has_other_limit(result, trained_for)


def has_other_limit(result: Evaluation, trained_for: EnvironmentSpec | None) -> bool:
    """Return whether the episodes had another time limit than the specification that the policy was trained for."""
    return trained_for is not None and result.limit != trained_for.time_limit


def paired_start(result: Evaluation, among: int) -> int:
    """Return the index of the episode whose start is used to compare controllers step by step: of the first ``among``
    episodes, the one in which the policy had its median return."""
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


def is_storable(step: StepOfEpisode) -> bool:
    """Return whether a server can store the numbers of a step."""
    numbers = np.array([*step.coordinates, *step.action, *step.next_coordinates, step.reward])
    return bool((np.abs(numbers) <= MAX_MEASURED).all())


def as_logged(spec: EnvironmentSpec, samples: Sequence[NewSample]) -> list[NewSample]:
    """Return steps in the form in which an import would send them: with wrapped angles.

    The server recognises the steps of a log by their values, to the last bit. So steps that it has stored already count
    as duplicates in an import. Equal steps within the list are all kept, because each was taken.
    """
    angles = [i for i, coordinate in enumerate(spec.coordinates) if coordinate.kind == "angle"]
    return [_with_wrapped(angles, sample) for sample in samples]


def write_steps(policy: Path, spec: EnvironmentSpec, samples: Sequence[NewSample]) -> Path:
    """Write steps to a new file beside a policy, such as ``policy.steps.npz``, and return its path. If the folder can't
    be written to, the file is written to the working directory. An existing file is never replaced, because it
    contains other steps.

    Raises:
        OSError: neither folder can be written to.
    """
    content = _content(spec, samples)
    try:
        return _write_new(policy.parent, policy.stem, content)
    except OSError:
        return _write_new(Path(), policy.stem, content)


def rewrite_steps(file: Path, spec: EnvironmentSpec, samples: Sequence[NewSample]) -> None:
    """Replace the steps in a file that ``write_steps`` wrote. Raises ``OSError`` if that fails; the file then stays
    unchanged."""
    part = file.with_suffix(".part")
    part.write_bytes(_content(spec, samples))
    os.replace(part, file)


def _content(spec: EnvironmentSpec, samples: Sequence[NewSample]) -> bytes:
    fields = ("coordinates", "action", "next_coordinates", "reward", "terminated")
    arrays = {name: np.array([getattr(sample, name) for sample in samples]) for name in fields}
    return npz_of_steps(spec.coordinate_names, arrays | {EVALUATED: np.array(True)})


def _write_new(folder: Path, stem: str, content: bytes) -> Path:
    for number in count(1):
        file = folder / f"{stem}.steps{'' if number == 1 else f'-{number}'}.npz"
        try:
            opened = file.open("xb")
        except FileExistsError:
            continue
        try:
            with opened:
                opened.write(content)
        except OSError:
            file.unlink(missing_ok=True)
            raise
        return file
    raise AssertionError("unreachable: the loop over file numbers does not end")


def _with_wrapped(angles: Sequence[int], sample: NewSample) -> NewSample:
    if not angles:
        return sample
    return sample.model_copy(
        update={name: _wrapped(angles, getattr(sample, name)) for name in ("coordinates", "next_coordinates")}
    )


def _wrapped(angles: Sequence[int], values: Sequence[float]) -> list[float]:
    turned = np.array(values)
    turned[list(angles)] = wrapped(turned[list(angles)])
    return [float(value) for value in turned]
