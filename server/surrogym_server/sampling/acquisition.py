"""Which point to query next (eq. 12 and 13), over a candidate set, in logarithms."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surrogym_server.sampling.confidence import deviations, log_model_uncertainty
from surrogym_server.sampling.occupancy import log_occupancy
from surrogym_server.surrogate.definition import EnvironmentDefinition
from surrogym_server.surrogate.features import FeatureMap, encode, leading
from surrogym_server.surrogate.model import OutputModel, SurrogateModel

NEAR = 0.02  # queries closer than this, in deviations of the sampling range, are near-duplicates


@dataclass(frozen=True)
class Candidates:
    """Points to choose from, and their occupancy."""

    q: Tensor  # (m, C)
    u: Tensor  # (m, F)
    log_p: Tensor  # (m,) log P_i


def candidates_of(model: SurrogateModel, q: Tensor, u: Tensor, states: Tensor | None) -> Candidates:
    """Candidates q (m, C), u (m, F) with P_i from visited states (v, C).

    Without any, preset ``paper`` takes the density of the predicted next states at each candidate's own, and the
    default calls every state equally likely.
    """
    definition = model.definition
    if states is not None and len(states):
        return Candidates(q, u, log_occupancy(definition, states, q))
    if definition.design.preset == "paper":
        arrived = model.transition(q, u).q_next
        return Candidates(q, u, log_occupancy(definition, arrived, arrived, floor=1e-12))
    return Candidates(q, u, q.new_zeros(len(q)))


def acquisition(model: SurrogateModel, candidates: Candidates, column: int, tolerance: float) -> Tensor:
    """Value of querying each candidate for the sake of one output, (m,); only its order counts.

    ``uncertainty_index``: log U = log Phi(-tau / sigma) + log P (eq. 12). ``variance``: log sigma.
    """
    deviation = deviations(model, candidates.q, candidates.u)[:, column]
    if model.definition.design.acquisition == "variance":
        return deviation.log()
    return log_model_uncertainty(deviation, tolerance) + candidates.log_p


def condition_on(model: SurrogateModel, q: Tensor, u: Tensor) -> SurrogateModel:
    """The model as if q (C,), u (F,) had been answered as predicted: variances shrink, means stay (greedy batches)."""
    definition = model.definition
    q_next = model.transition(q[None], u[None]).q_next
    lead = q_next[:, leading(definition)]
    state = q_next if model.reward.feature_map.after else q[None]

    def extended(output: OutputModel, at: Tensor) -> OutputModel:
        if output.posterior is None:
            return output
        x = encode(definition, output.feature_map, at, u[None], lead)
        return replace(output, posterior=output.posterior.extend(x[0], output.posterior.mean(x)[0]))

    transitions = tuple(extended(o, q[None]) for o in model.transitions)
    return replace(model, transitions=transitions, reward=extended(model.reward, state))


def near(definition: EnvironmentDefinition, q: Tensor, u: Tensor, taken_q: Tensor, taken_u: Tensor) -> Tensor:
    """Which of q (m, C), u (m, F) all but repeat one of taken_q (t, C), taken_u (t, F): (m,) bool."""
    if not len(taken_q):
        return torch.zeros(len(q), dtype=torch.bool)
    plain = FeatureMap()
    distance = torch.cdist(encode(definition, plain, q, u), encode(definition, plain, taken_q, taken_u))
    return (distance < NEAR).any(1)
