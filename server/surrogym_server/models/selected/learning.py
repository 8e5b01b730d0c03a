"""Learning of a model of selected families: candidates are compared on held-out pieces, and those chosen are fitted to
all samples."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples, increments
from surrogym_server.errors import SurrogymError
from surrogym_server.models.port import DynamicsModel, Learned, Learner, Warm
from surrogym_server.models.selected.held_out import FEWEST, HeldOut, held_out
from surrogym_server.models.selected.model import SelectedModel
from surrogym_server.models.selected.scores import Scores, horizons_of, scores
from surrogym_server.models.selected.selection import (
    Before,
    Evidence,
    Selection,
    Standing,
    decided,
    from_warm,
    warm_of,
)
from surrogym_server.models.singles import GAUSSIAN_PROCESS, SPARSE_GAUSSIAN_PROCESS
from surrogym_server.plugins import in_one_line

WarmArrays = dict[str, NDArray[np.float64]]


def learn(
    learners: Mapping[str, Learner], margin: float, definition: EnvironmentDefinition, samples: Samples, warm: Warm
) -> Learned:
    """Learn as ``Learner.learn`` says. The first candidate serves until another one is better."""
    names, outputs = tuple(learners), len(definition.outputs)
    begun = Before((names[0],) * outputs, ({},) * outputs, first=True)
    before = from_warm(names, outputs, warm) or begun
    comparison = _compare(learners, definition, samples, warm, before)
    serving, standings = decided(before, comparison.standings, margin)
    if definition.declared_reward is not None:
        serving = (*serving[:-1], max(serving[:-1], key=serving[:-1].count))  # it is exact in every family
    selection = Selection(names, serving, comparison.evidence, standings)
    models, left = dict[str, DynamicsModel](), comparison.warm
    for name in dict.fromkeys(serving):
        learned = learners[name].learn(definition, samples, _own(warm, name))
        models[name] = learned.model
        left |= _named(name, learned.warm)
    compared = any(standings) or before is not begun
    return Learned(SelectedModel.of(definition, models, selection), left | (warm_of(selection) if compared else {}))


@dataclass(frozen=True)
class _Comparison:
    evidence: Evidence
    standings: tuple[tuple[Standing, ...], ...]  # (O,)
    warm: WarmArrays  # that the fits of the candidates have left


@dataclass(frozen=True)
class _Scored:
    """Scores by family, of an output (O,) each."""

    by_family: dict[str, list[Scores]]
    failed: dict[str, str]
    warm: WarmArrays


def _compare(
    learners: Mapping[str, Learner], definition: EnvironmentDefinition, samples: Samples, warm: Warm, before: Before
) -> _Comparison:
    outputs = len(definition.outputs)
    held = held_out(definition, samples)
    if held is None:
        note = f"nothing is compared with fewer than {FEWEST} samples"
        return _Comparison(Evidence("none", notes=(note,)), ((),) * outputs, {})
    rivals, notes = _rivals(tuple(learners), before.serving, len(samples), learners)
    scored = _scored({name: learners[name] for name in rivals}, definition, samples, warm, before.serving, held)
    notes += tuple(f"{name} failed: {why}" for name, why in scored.failed.items())
    standings = tuple(
        ()
        if definition.declared_reward is not None and column == outputs - 1
        else _standings(scored.by_family, before.serving[column], column)
        for column in range(outputs)
    )
    horizons = horizons_of([piece for fold in held.folds for piece in fold])
    evidence = Evidence(held.kind, held.pieces, horizons, len(held.folds), notes)
    return _Comparison(evidence, standings, scored.warm)


def _rivals(
    names: tuple[str, ...], serving: Sequence[str], samples: int, learners: Mapping[str, Learner]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Candidates to compare, and a note about one that is left out because another one is the same."""
    sparse = learners.get(SPARSE_GAUSSIAN_PROCESS)
    limit = getattr(sparse, "exact", 0)
    same = sparse is not None and GAUSSIAN_PROCESS in names and SPARSE_GAUSSIAN_PROCESS not in serving
    if not same or samples > limit:
        return names, ()
    note = f"{SPARSE_GAUSSIAN_PROCESS} is the same as {GAUSSIAN_PROCESS} with at most {limit} samples"
    return tuple(name for name in names if name != SPARSE_GAUSSIAN_PROCESS), (note,)


def _scored(
    learners: Mapping[str, Learner],
    definition: EnvironmentDefinition,
    samples: Samples,
    warm: Warm,
    serving: Sequence[str],
    held: HeldOut,
) -> _Scored:
    """Fit every family without each fold in turn, and score it on the fold."""
    found: dict[str, list[list[Scores]]] = {name: [] for name in learners}
    failed, left = dict[str, str](), WarmArrays()
    scale = _scale(definition, samples)
    for fold in held.folds:
        rest = torch.ones(len(samples), dtype=torch.bool)
        rest[torch.cat(fold)] = False
        models = dict[str, DynamicsModel]()
        for name, learner in learners.items():
            if name in failed:
                continue
            try:
                learned = learner.learn(definition, samples.at(rest.nonzero()[:, 0]), _own(warm, name))
            except (SurrogymError, ArithmeticError, ValueError, RuntimeError) as error:
                failed[name] = in_one_line(error)
            else:
                models[name] = learned.model
                left |= _named(name, learned.warm)
        if not set(serving) <= set(models):
            return _Scored({}, failed, left)
        for name, by_output in _by_family(definition, models, serving, samples, fold, scale).items():
            found[name].append(by_output)
    whole = {name: _joined(folds) for name, folds in found.items() if name not in failed}
    return _Scored(whole, failed, left)


def _by_family(
    definition: EnvironmentDefinition,
    models: dict[str, DynamicsModel],
    serving: Sequence[str],
    samples: Samples,
    fold: Sequence[Tensor],
    scale: Tensor,
) -> dict[str, list[Scores]]:
    """Scores of every output by family: with this family in the place of the one that serves, and all other outputs as
    they are served."""
    cache = dict[tuple[str, ...], tuple[Scores, ...]]()

    def scored(names: tuple[str, ...]) -> tuple[Scores, ...]:
        if names not in cache:
            selection = Selection(tuple(models), names, Evidence("none"), ((),) * len(names))
            cache[names] = scores(SelectedModel.of(definition, models, selection), samples, fold, scale)
        return cache[names]

    return {name: [scored((*serving[:c], name, *serving[c + 1 :]))[c] for c in range(len(serving))] for name in models}


def _joined(folds: Sequence[Sequence[Scores]]) -> list[Scores]:
    """Scores of all folds together, by output."""
    return [
        Scores(torch.cat([s.density for s in parts]), torch.cat([s.inside for s in parts]))
        for parts in zip(*folds, strict=True)
    ]


def _standings(by_family: Mapping[str, Sequence[Scores]], had: str, column: int) -> tuple[Standing, ...]:
    """Compare the families on one output with the one that had served it."""
    if had not in by_family:
        return ()
    base = by_family[had][column]
    found = []
    for name, columns in by_family.items():
        one = columns[column]
        known = one.density.isfinite() & base.density.isfinite()
        if int(known.sum()) < FEWEST:
            continue
        found.append(compared(name, *(Scores(side.density[known], side.inside[known]) for side in (one, base))))
    return tuple(found) if any(one.family == had for one in found) else ()


def compared(name: str, one: Scores, base: Scores) -> Standing:
    """Compare scores of a family with those of another one on the same pieces. Errors are those over pieces, because
    steps of one piece are not independent."""
    better, lost = one.density - base.density, base.inside - one.inside
    error, coverage_error = (float(side.std()) / math.sqrt(len(side)) for side in (better, lost))
    score, difference, coverage = (float(side.mean()) for side in (one.density, better, one.inside))
    return Standing(name, score, difference, error, coverage, coverage_error=coverage_error)


def _scale(definition: EnvironmentDefinition, samples: Samples) -> Tensor:
    """Standard deviation of every output over the samples (O,); 1 for an output that never varied."""
    outputs = torch.cat([increments(definition, samples), samples.reward[:, None]], 1)
    scale = outputs.std(0, correction=0)
    return torch.where(scale > 0, scale, 1.0)


def _own(warm: Warm, name: str) -> Warm:
    """A family's own part of a warm start."""
    return {key.removeprefix(f"{name}/"): array for key, array in warm.items() if key.startswith(f"{name}/")}


def _named(name: str, warm: Warm) -> WarmArrays:
    return {f"{name}/{key}": array for key, array in warm.items()}
