"""Sets of states learned from labelled states: where episodes end, and where a reward jumps.

A region is a mixture of forms of two kinds. ``Thresholds``: levels of single axes found from data, joined by *or*
(their complement by *and*), each known up to a gap between the last state seen outside and the first seen inside.
``Classifier``: a process on labels +-1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import encode
from surrogym_server.environment.terms import PartDefinition, TermDefinition, TermSet, compile_terms
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.tensors import cached, to_device

TERMINATION = "termination"  # name of the region where episodes end
Side = Literal["above", "below", "beyond"]  # of a threshold on t: t > level, -t > level, |t| > level
SIDES: tuple[Side, ...] = ("above", "below", "beyond")


@dataclass(frozen=True)
class Axes:
    """Axes along which a threshold can lie: x, -x and |x| for each x of T coordinates and observation entries.

    There are A = 3 T axes.
    """

    names: tuple[str, ...]  # (T,) names of the coordinates and observation entries
    terms: TermSet

    @classmethod
    def of(cls, definition: EnvironmentDefinition) -> Axes:
        """Build the axes of the moving coordinates, and of those observation entries that are not one of them."""
        size, names = len(definition.coordinates), {}
        for index in definition.moving:
            weights = tuple(float(i == index) for i in range(size))
            names[TermDefinition((PartDefinition("linear", 1.0, weights),))] = definition.coordinates[index].name
        for name, term in zip(definition.observation_names, definition.observation_terms, strict=True):
            names.setdefault(term, name)
        return cls(tuple(names.values()), to_device(compile_terms(list(names), size), definition.device))

    def __len__(self) -> int:
        return 3 * len(self.names)

    def __call__(self, q: Tensor) -> Tensor:
        """Return the values of all axes at q (m, C), (m, A)."""
        value = self.terms(q)
        return torch.cat([value, -value, value.abs()], -1)

    def describe(self, axis: int, level: float) -> str:
        """Return the inequality that ``axis`` exceeds ``level``, for display, such as `x > 0.5`."""
        name, side = self.names[axis % len(self.names)], SIDES[axis // len(self.names)]
        return {"above": f"{name} > {level:.6g}", "below": f"{name} < {-level:.6g}"}.get(
            side, f"|{name}| > {level:.6g}"
        )


@dataclass(frozen=True)
class Cut:
    """Threshold on one axis. A state is inside if its value on the axis exceeds the threshold, which is only known to
    lie between ``outside`` and ``inside``."""

    axis: int
    outside: float  # greatest value on the axis of a state seen outside
    inside: float  # least value on the axis of a state seen inside
    weight: float  # probability of this axis among those that explain the same samples


@dataclass(frozen=True)
class Thresholds:
    """Region of the states for which any rule holds. A rule lists alternative cuts that explain the same samples."""

    definition: EnvironmentDefinition
    rules: tuple[tuple[Cut, ...], ...]
    complement: bool = False  # if true, the region consists of the states for which no rule holds

    def probability(self, q: Tensor) -> Tensor:
        """Return the probability that q (m, C) lies inside, (m,), if each level is uniform within its gap."""
        return self.at(self._axes(q))

    def at(self, values: Tensor) -> Tensor:
        """Return the probability of lying inside, (m,), at given values of all axes (m, A)."""
        columns, outside, width, membership = self._compiled
        reached = ((values[:, columns] - outside) / width).clamp(0, 1)
        union = 1 - (1 - reached @ membership).clamp(0, 1).prod(-1)
        return 1 - union if self.complement else union

    @property
    def description(self) -> Mapping[str, Any]:
        """Rules in words, with the gaps in which their thresholds lie."""
        rules = [
            [
                {
                    "rule": self._axes.describe(cut.axis, (cut.outside + cut.inside) / 2),
                    "gap": cut.inside - cut.outside,
                    "weight": cut.weight,
                }
                for cut in rule
            ]
            for rule in self.rules
        ]
        words = "none of" if self.complement else "any of"
        return {"kind": "thresholds", "inside": words, "rules": rules}

    @cached
    def _axes(self) -> Axes:
        return Axes.of(self.definition)

    @cached
    def _compiled(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Axis, outside value and width of the gap of every cut, (K,) each, and each cut's weight in its rule,
        (K, R)."""
        cuts = [(row, cut) for row, rule in enumerate(self.rules) for cut in rule]
        outside = torch.tensor([cut.outside for _, cut in cuts], dtype=torch.float64)
        inside = torch.tensor([cut.inside for _, cut in cuts], dtype=torch.float64)
        membership = outside.new_zeros(len(cuts), len(self.rules))
        for place, (row, cut) in enumerate(cuts):
            membership[place, row] = cut.weight
        compiled = torch.tensor([cut.axis for _, cut in cuts]), outside, inside - outside, membership
        return to_device(compiled, self.definition.device)


@dataclass(frozen=True)
class Classifier:
    """Region learned by a process of labels +-1 (least-squares classification, Rasmussen and Williams (2006), section
    6.5)."""

    definition: EnvironmentDefinition
    process: OutputModel

    def probability(self, q: Tensor) -> Tensor:
        """Return the probability that q (m, C) lies inside, (m,): that the process is above 0 there."""
        u = q.new_zeros(len(q), self.definition.action.size)
        mean, std = self.process.mean_and_std(encode(self.definition, self.process.feature_map, q, u))
        return likely(mean, std)

    @property
    def description(self) -> Mapping[str, Any]:
        """Kind and inputs of the classifier, for display."""
        return {"kind": "classifier", "inputs": str(self.process.feature_map)}


Form = Thresholds | Classifier


@dataclass(frozen=True)
class Region:
    """Learned set of states: a mixture of forms that explain the labels. Where they disagree, it is uncertain."""

    forms: tuple[tuple[float, Form], ...]  # forms with their weights, which add up to 1
    scores: tuple[tuple[str, float], ...]  # leave-one-out log probability of every form that was compared

    def probability(self, q: Tensor) -> Tensor:
        """Return the probability that q (m, C) lies inside, (m,)."""
        mixed = torch.stack([weight * form.probability(q) for weight, form in self.forms]).sum(0)
        return mixed.clamp(0, 1)  # because of rounding, the weighted sum may exceed 1

    @property
    def description(self) -> dict[str, Any]:
        """All forms of the region in words, with their scores, for display."""
        forms = [{"weight": weight, **form.description} for weight, form in self.forms]
        return {"forms": forms, "scores": dict(self.scores)}


@dataclass(frozen=True)
class Jump:
    """Region inside which the reward is higher by ``size`` (lower if negative)."""

    region: Region
    size: float


def jumped(jumps: Sequence[Jump], q: Tensor) -> tuple[Tensor, Tensor]:
    """Return what jumps add to the reward of states q (m, C), and its variance from uncertain edges, (m,) each.

    If the regions of jumps overlap, the first one counts.
    """
    added, variance, free = q.new_zeros(len(q)), q.new_zeros(len(q)), q.new_ones(len(q), dtype=torch.bool)
    for jump in jumps:
        inside = jump.region.probability(q)
        added = added + jump.size * ((inside > 0.5) & free)
        variance = variance + jump.size**2 * inside * (1 - inside) * free
        free = free & (inside <= 0.5)
    return added, variance


def likely(mean: Tensor, std: Tensor) -> Tensor:
    """Return the probability (m,) that a normal variable with this mean and standard deviation is above 0."""
    probability: Tensor = torch.special.ndtr(mean / std.clamp_min(1e-9))
    return probability
