"""Decide by evidence which outputs are the same function of different inputs and share samples; see ``gp.pooling``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from surrogym_server.errors import NumericalFailure
from surrogym_server.gp import Part, Pool, condition, pools, subsets
from surrogym_server.models.gaussian_process.feature_maps import reflection
from surrogym_server.models.gaussian_process.learning.dropping import WIN, map_without
from surrogym_server.models.gaussian_process.learning.output_learner import OutputLearner, is_unexplained
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel

ROLES = 4  # outputs share their samples only if the function that they have in common reads at most this many inputs
# An output that shares samples learns from at most this many; if there are more, samples of other outputs are left out.
MOST = subsets.FEW


@dataclass(frozen=True)
class _Candidate:
    """Output that may share its samples with other outputs, and its samples in the form that ``gp.pooling`` needs."""

    place: int  # index of the output in the model
    output: OutputModel
    part: Part
    # For each input of ``part``, its index among all features in the output's encoding of state and action, ignored
    # features included.
    every: tuple[int, ...]


def with_samples_of_others(learner: OutputLearner, outputs: Sequence[OutputModel]) -> tuple[OutputModel, ...]:
    """Return the outputs in the same order, after those that are the same function of different inputs have also
    learned from each other's samples."""
    shared = list(outputs)
    if not learner.settings.repeated_parts or not any(_is_to_learn(learner, output) for output in outputs):
        return tuple(shared)
    candidates = [
        candidate
        for place, output in enumerate(outputs)
        if (candidate := _candidate(learner, place, output)) is not None
    ]
    try:
        together = pools([candidate.part for candidate in candidates], ROLES)
    except NumericalFailure:
        return tuple(shared)
    for pool in together:
        if pool.gain > WIN * max(len(part.y) for part in pool.parts):
            members = [candidates[number] for number in pool.numbers]
            for member, candidate in enumerate(members):
                shared[candidate.place] = _sharing(members, pool, member)
    return tuple(shared)


def _is_to_learn(learner: OutputLearner, output: OutputModel) -> bool:
    """Return whether a search for outputs that are the same function as this output is worthwhile: its process does not
    predict well yet, and it is known which inputs it needs."""
    unexplained = output.posterior is not None and is_unexplained(output.posterior)
    return unexplained and output.name in learner.selections


def _candidate(learner: OutputLearner, place: int, output: OutputModel) -> _Candidate | None:
    """Return the output as a candidate for sharing samples with other outputs; None if it can't share. ``place`` is its
    index in the model."""
    posterior, selection, feature_map = output.posterior, learner.selections.get(output.name), output.feature_map
    if posterior is None or posterior.sparse is not None or feature_map.rates or output.at_limit:
        return None
    if output.size_with_prior is not None:
        return None
    if selection is None and not feature_map.dropped:
        return None
    mirror = reflection(learner.definition, replace(feature_map, parity="odd"))
    size = posterior.x.shape[1]
    reads, fewer = tuple(range(size)), posterior.hyper
    if not feature_map.dropped and selection is not None:
        reads, fewer = tuple(selection.mask.nonzero()[:, 0].tolist()), selection.hyper
    part = Part(
        posterior.x,
        posterior.y,
        posterior.hyper,
        output.centre,
        output.scale,
        learner.options(output.name),
        reads,
        fewer,
        None if mirror is None else mirror.signs,
    )
    every = tuple(i for i in range(size + len(feature_map.dropped)) if i not in feature_map.dropped)
    return _Candidate(place, output, part, every)


def _sharing(members: Sequence[_Candidate], pool: Pool, member: int) -> OutputModel:
    """Return the output of the pool's member with index ``member``, learned from the samples of all members. If it then
    predicts its own samples worse, return the output as learned from its own samples alone."""
    candidate, output = members[member], members[member].output
    assert output.posterior is not None
    x, y, hyper = pool.samples_of(member, MOST)
    try:
        posterior = condition(hyper, x, y)
    except NumericalFailure:
        return output
    predictions, _ = posterior.leave_one_out()
    off = (predictions - y)[: len(candidate.part.y)].square().mean().sqrt()
    if float(off) > output.posterior.left_out.error:
        return output
    whole = replace(output.feature_map, dropped=(), parity=members[0].output.feature_map.parity)
    mask = torch.zeros(len(candidate.every) + len(output.feature_map.dropped), dtype=torch.bool)
    mask[[candidate.every[place] for place in pool.inputs[member]]] = True
    others = tuple(other.output.name for other in members if other is not candidate)
    scores = (*output.scores, (str(candidate_map := map_without(whole, mask)), pool.gain))
    centre = pool.parts[0].centre
    return replace(output, feature_map=candidate_map, posterior=posterior, centre=centre, scores=scores, shared=others)
