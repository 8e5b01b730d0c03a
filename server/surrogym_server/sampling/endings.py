"""Find candidates for queries at which an episode may end or the reward jumps, because the model needs samples from
both sides of such an edge."""

from __future__ import annotations

from collections.abc import Iterator

from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.models.abilities import RewardEdges, offers
from surrogym_server.models.port import DynamicsModel

# If no candidate's next state is farther than this outside the range of the samples' states, in widths of this range,
# no query is reserved to search there for an unknown termination.
FRONTIER = 0.1
# If the probability that the model is wrong about a termination or a jump of the reward, as a mean over the candidates,
# is at most this, no query is reserved to find out.
DOUBT = 0.005


def ending(model: DynamicsModel, samples: Samples, points: Points) -> Tensor | None:
    """Return (m,) bool: which of m candidates are reserved for the next query, because it should show where episodes
    end or where the reward jumps. Return None if this is known well enough.

    Several groups are tried, and the first that is not empty is reserved. With a declared termination: the points at
    which the model predicts an end, as long as no sample has ended an episode; then the points at which a jump of the
    reward is doubtful. With a learned termination: the points at which it is most doubtful whether the episode ends;
    then the points at which a jump of the reward is doubtful; then the points whose next state lies farthest outside
    the range of known non-terminal states, where an unknown termination may lie.
    """
    q_next = model.transition(points.q, points.u).q_next
    if not model.definition.learns_termination:
        unseen = None if bool(samples.terminated.any()) else _predicted(model, points, q_next)
        return _edges(model, points, q_next) if unseen is None else unseen
    doubt = in_doubt(model, q_next)
    if float(doubt.mean()) > DOUBT:
        return doubt >= 0.5 * doubt.max()
    if (edges := _edges(model, points, q_next)) is not None:
        return edges
    beyond = unexplored(model.definition, samples.q_next[~samples.terminated], q_next) * ~model.terminated(q_next)
    return beyond >= 0.9 * beyond.max() if float(beyond.max()) > FRONTIER else None


def in_doubt(model: DynamicsModel, q_next: Tensor) -> Tensor:
    """Return the probability (m,) that the model is wrong about whether an episode ends at q_next (m, C); 0 if
    termination is declared."""
    probability = model.termination_probability(q_next)
    return probability.minimum(1 - probability)


def edge_in_doubt(model: DynamicsModel, q: Tensor, q_next: Tensor) -> Tensor:
    """Return the probability (m,), for steps from q (m, C) to q_next (m, C), that the model is wrong about whether the
    step lies inside a region at whose edge the reward jumps. If there are several regions, it is the largest
    probability."""
    doubt = q.new_zeros(len(q))
    for of_one in _edge_doubts(model, q, q_next):
        doubt = doubt.maximum(of_one)
    return doubt


def _edges(model: DynamicsModel, points: Points, q_next: Tensor) -> Tensor | None:
    """Return (m,) bool: which of m candidates, steps from ``points`` to q_next (m, C), are the most doubtful at an edge
    where the reward jumps. The probability that the model is wrong about their side of the edge is at least half the
    largest one. The first doubtful edge is used. The result is None if no edge is doubtful."""
    for doubt in _edge_doubts(model, points.q, q_next):
        if float(doubt.mean()) > DOUBT:
            return doubt >= 0.5 * doubt.max()
    return None


def _edge_doubts(model: DynamicsModel, q: Tensor, q_next: Tensor) -> Iterator[Tensor]:
    """Return an iterator that yields, for each region at whose edge the reward jumps, the probability (m,) that the
    model is wrong about whether the step from q (m, C) to q_next (m, C) lies inside."""
    edged = offers(model, RewardEdges)
    return iter(()) if edged is None else edged.reward_edge_doubts(q, q_next)


def _predicted(model: DynamicsModel, points: Points, q_next: Tensor) -> Tensor | None:
    ends = model.terminated(q_next) & ~model.terminated(points.q)
    return ends if bool(ends.any()) else None


def unexplored(definition: EnvironmentDefinition, states: Tensor, q: Tensor) -> Tensor:
    """Return (m,) numbers: how far each of m states q (m, C) lies outside the range of earlier ``states`` (n, C). An
    unknown termination may lie there.

    Each moving coordinate contributes its distance from its range over the earlier states, in widths of this range and
    at most 1. The result is the sum; it is 1 if there are no earlier states.
    """
    columns = list(definition.moving)
    if not len(states):
        return q.new_ones(len(q))
    low, high = states[:, columns].amin(0), states[:, columns].amax(0)
    width = (high - low).clamp_min(1e-12)
    at = q[:, columns]
    return (((at - high) / width).clamp_min(0) + ((low - at) / width).clamp_min(0)).clamp_max(1).sum(-1)
