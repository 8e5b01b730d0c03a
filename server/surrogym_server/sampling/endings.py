"""Queries reserved for the end of an episode and for edges of the reward, where the model needs samples from both
sides."""

from __future__ import annotations

from collections.abc import Iterator

from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.models.abilities import RewardEdges, offers
from surrogym_server.models.port import DynamicsModel

FRONTIER = 0.1  # states closer than this to the range of earlier states, in widths of it, are not worth a query
DOUBT = 0.005  # acceptable mean probability, over the candidates, that the model is wrong about a termination


def ending(model: DynamicsModel, samples: Samples, points: Points) -> Tensor | None:
    """Return which of m candidates are reserved for a query about the end of episodes, (m,) bool; None if none is.

    With a declared termination: the points predicted to end an episode, until a sample has ended one; then those at
    which the side of a jump of the reward is doubtful. With a learned termination: the points at which it is most
    doubtful, until little doubt is left; then those with a doubtful jump; then those farthest beyond the states known
    to be non-terminal, where another termination may lie.
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
    """Return the probability that the model is wrong about a termination at q_next (m, C), (m,); 0 if it is
    declared."""
    probability = model.termination_probability(q_next)
    return probability.minimum(1 - probability)


def edge_in_doubt(model: DynamicsModel, q: Tensor, q_next: Tensor) -> Tensor:
    """Return the probability that the model is wrong about the side of an edge of the reward, (m,), for steps from
    q (m, C) to q_next (m, C). Of several edges, the largest probability counts."""
    doubt = q.new_zeros(len(q))
    for of_one in _edge_doubts(model, q, q_next):
        doubt = doubt.maximum(of_one)
    return doubt


def _edges(model: DynamicsModel, points: Points, q_next: Tensor) -> Tensor | None:
    """Return at which candidates it is most doubtful on which side of a reward edge a step ends, (m,) bool; None if no
    edge is in doubt."""
    for doubt in _edge_doubts(model, points.q, q_next):
        if float(doubt.mean()) > DOUBT:
            return doubt >= 0.5 * doubt.max()
    return None


def _edge_doubts(model: DynamicsModel, q: Tensor, q_next: Tensor) -> Iterator[Tensor]:
    """Return an iterator over the edges of the reward: the probability (m,) that the model is wrong about the side."""
    edged = offers(model, RewardEdges)
    return iter(()) if edged is None else edged.reward_edge_doubts(q, q_next)


def _predicted(model: DynamicsModel, points: Points, q_next: Tensor) -> Tensor | None:
    ends = model.terminated(q_next) & ~model.terminated(points.q)
    return ends if bool(ends.any()) else None


def unexplored(definition: EnvironmentDefinition, states: Tensor, q: Tensor) -> Tensor:
    """Return how far states q (m, C) lie outside of the range of earlier states (n, C), where an unknown termination
    may lie: (m,).

    The result is the sum over both ends of every moving coordinate, in widths of that range; 1 if there are no earlier
    states.
    """
    columns = list(definition.moving)
    if not len(states):
        return q.new_ones(len(q))
    low, high = states[:, columns].amin(0), states[:, columns].amax(0)
    width = (high - low).clamp_min(1e-12)
    at = q[:, columns]
    return (((at - high) / width).clamp_min(0) + ((low - at) / width).clamp_min(0)).clamp_max(1).sum(-1)
