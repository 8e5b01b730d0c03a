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

FRONTIER = 0.1  # widths of the range of the states so far; states less far outside are not worth a query
DOUBT = 0.005  # acceptable mean probability, over the candidates, that the model is wrong about an ending


def ending(model: DynamicsModel, samples: Samples, points: Points) -> Tensor | None:
    """Whether each of m candidates is reserved for a query about the end of episodes, (m,) bool; None if none is.

    With a declared termination these are the points predicted to end an episode, until a sample has ended one. With a
    learned termination they are the most doubtful points, until little doubt is left, and then the points farthest
    beyond the states known to be non-terminal, where another end may lie. If the reward jumps, the points at which the
    side of the jump is doubtful are added.
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
    """Probability that the model is wrong about an ending at q_next (m, C), (m,); 0 if termination is declared."""
    probability = model.termination_probability(q_next)
    return probability.minimum(1 - probability)


def edge_in_doubt(model: DynamicsModel, q: Tensor, q_next: Tensor) -> Tensor:
    """Probability (m,) that the model is wrong about the side of an edge of the reward: the largest over all edges.

    The steps lead from q (m, C) to q_next (m, C).
    """
    doubt = q.new_zeros(len(q))
    for of_one in _edge_doubts(model, q, q_next):
        doubt = doubt.maximum(of_one)
    return doubt


def _edges(model: DynamicsModel, points: Points, q_next: Tensor) -> Tensor | None:
    """Whether each candidate is among those at which the side of an edge of the reward is most doubtful, (m,) bool."""
    for doubt in _edge_doubts(model, points.q, q_next):
        if float(doubt.mean()) > DOUBT:
            return doubt >= 0.5 * doubt.max()
    return None


def _edge_doubts(model: DynamicsModel, q: Tensor, q_next: Tensor) -> Iterator[Tensor]:
    """For each edge of the reward, the probability (m,) that the model is wrong about the side of m points."""
    edged = offers(model, RewardEdges)
    return iter(()) if edged is None else edged.reward_edge_doubts(q, q_next)


def _predicted(model: DynamicsModel, points: Points, q_next: Tensor) -> Tensor | None:
    ends = model.terminated(q_next) & ~model.terminated(points.q)
    return ends if bool(ends.any()) else None


def unexplored(definition: EnvironmentDefinition, states: Tensor, q: Tensor) -> Tensor:
    """How far states q (m, C) lie outside of the range of the states so far (n, C): (m,).

    An unknown ending may lie there. The result is the sum over both ends of every moving coordinate, in widths of that
    range.
    """
    columns = list(definition.moving)
    if not len(states):
        return q.new_ones(len(q))
    low, high = states[:, columns].amin(0), states[:, columns].amax(0)
    width = (high - low).clamp_min(1e-12)
    at = q[:, columns]
    return (((at - high) / width).clamp_min(0) + ((low - at) / width).clamp_min(0)).clamp_max(1).sum(-1)
