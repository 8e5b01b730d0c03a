"""What further queries would do to a model's deviations, before any of them is answered.

The deviations of a process depend on where it is observed, not on what was seen there. So the outlook after a query
needs no guess of its answer; only processes that read a predicted value (the lead, the next state of a reward) take the
prediction of the model at hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surrogym_server.environment.features import encode, leading
from surrogym_server.gp import Joint
from surrogym_server.models.gaussian_process.learning.learn import usable
from surrogym_server.models.gaussian_process.prediction.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel


@dataclass(frozen=True)
class Points:
    """Where a model is looked at."""

    q: Tensor  # (m, C)
    u: Tensor  # (m, F)

    def __len__(self) -> int:
        return len(self.q)

    def __getitem__(self, index: slice | Tensor | list[int]) -> Points:
        return Points(self.q[index], self.u[index])

    @classmethod
    def joined(cls, parts: Sequence[Points]) -> Points:
        return cls(torch.cat([p.q for p in parts]), torch.cat([p.u for p in parts]))


@dataclass(frozen=True)
class Outlook:
    """Every output at m candidates and r reference points, as if some more queries had been answered."""

    outputs: tuple[OutputOutlook | None, ...]  # None: an output that never varied

    @classmethod
    def of(cls, model: GaussianProcessModel, candidates: Points, reference: Points, assumed: Points) -> Outlook:
        """The outlook once the queries ``assumed`` are answered."""
        everywhere = Points.joined([candidates, reference, assumed])
        q_next = model.transition(everywhere.q, everywhere.u).q_next
        spans = (len(candidates), len(candidates) + len(reference))
        outputs = (
            None
            if output.posterior is None
            else OutputOutlook.of(
                output, inputs_of(model, output, everywhere, q_next), counts_of(model, i, q_next), spans
            )
            for i, output in enumerate((*model.transitions, model.reward))
        )
        return cls(tuple(outputs))

    def observe(self, index: int) -> Outlook:
        """As if the candidate ``index`` had been answered as well."""
        return Outlook(tuple(None if output is None else output.observe(index) for output in self.outputs))


@dataclass(frozen=True)
class OutputOutlook:
    """One output, in its own unit."""

    joint: Joint  # at candidates, reference and what was assumed, in this order
    counts: Tensor  # (m,) bool: whether a candidate's answer would teach this output anything
    shared: Tensor  # (r, m) covariance of reference and candidates, standardised: kept, so that it is taken once
    scale: float

    @classmethod
    def of(cls, output: OutputModel, x: Tensor, counts: Tensor, spans: tuple[int, int]) -> OutputOutlook:
        """At inputs x (m + r + p, d): m candidates, r reference points, p points assumed observed."""
        assert output.posterior is not None
        joint = Joint.of(output.posterior, x)
        for index in range(spans[1], len(x)):
            joint = joint.observe(index) if counts[index] else joint
        shared = joint.between(slice(*spans), slice(spans[0]))
        return cls(joint, counts[: spans[0]], shared, output.scale)

    @property
    def deviation(self) -> Tensor:
        """Latent deviation at the candidates, (m,)."""
        return self.scale * self.joint.variance[: len(self.counts)].sqrt()

    def reduction(self, weights: Tensor) -> Tensor:
        """How much each candidate's answer lowers the variance over the reference, weighted by weights (r,): (m,).

        sum_r w_r k(x_r, x)^2 / (k(x, x) + sigma_n^2), Cohn (NIPS 1993), in closed form for a Gaussian process.
        """
        spread = self.joint.variance[: len(self.counts)] + self.joint.noise
        return self.scale**2 * (weights @ self.shared.square()) / spread

    def observe(self, index: int) -> OutputOutlook:
        if not self.counts[index]:
            return self
        joint = self.joint.observe(index)
        row, (r, m) = joint.observed[-1], self.shared.shape
        return replace(self, joint=joint, shared=torch.addr(self.shared, row[m : m + r], row[:m], alpha=-1))


def inputs_of(model: GaussianProcessModel, output: OutputModel, points: Points, q_next: Tensor) -> Tensor:
    """What one output's process reads at points whose predicted next coordinates are q_next (m, C): (m, d)."""
    after = output.feature_map.after
    lead = q_next[:, leading(model.definition)]
    return encode(model.definition, output.feature_map, q_next if after else points.q, points.u, lead)


def counts_of(model: GaussianProcessModel, column: int, q_next: Tensor) -> Tensor:
    """Which samples that end at q_next (m, C) an output would learn from, (m,) bool."""
    definition = model.definition
    if column == len(model.transitions):
        return ~model.terminated(q_next)
    return usable(definition, column, q_next, model.transitions[column].feature_map)
