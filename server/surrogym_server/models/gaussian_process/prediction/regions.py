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
Side = Literal["above", "below", "beyond"]  # t > level, -t > level, |t| > level
SIDES: tuple[Side, ...] = ("above", "below", "beyond")


@dataclass(frozen=True)
class Axes:
    """Every order of states by one value x: by x, -x and |x|, where x is one of T coordinates and observation entries.

    There are A = 3 T axes.
    """

    names: tuple[str, ...]  # (T,)
    terms: TermSet

    @classmethod
    def of(cls, definition: EnvironmentDefinition) -> Axes:
        """Axes of the moving coordinates, and of the observation entries that are not one of them."""
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
        """Values of all axes at q (m, C), (m, A)."""
        value = self.terms(q)
        return torch.cat([value, -value, value.abs()], -1)

    def describe(self, axis: int, level: float) -> str:
        """The inequality of ``axis`` and its ``level``, for people."""
        name, side = self.names[axis % len(self.names)], SIDES[axis // len(self.names)]
        return {"above": f"{name} > {level:.6g}", "below": f"{name} < {-level:.6g}"}.get(
            side, f"|{name}| > {level:.6g}"
        )


@dataclass(frozen=True)
class Cut:
    """Threshold on one axis. A state is inside the region if its value on the axis lies beyond the threshold, on the
    side of ``inside``. The threshold itself is only known to lie between ``outside`` and ``inside``."""

    axis: int
    outside: float
    inside: float
    weight: float  # probability of this axis among those that explain the same samples


@dataclass(frozen=True)
class Thresholds:
    """States lie inside if any of the rules holds. A rule holds the cuts that may explain its samples."""

    definition: EnvironmentDefinition
    rules: tuple[tuple[Cut, ...], ...]
    complement: bool = False  # inside if no rule holds

    def probability(self, q: Tensor) -> Tensor:
        """Probability that q (m, C) lies inside, (m,), with levels uniform within their gaps."""
        return self.at(self._axes(q))

    def at(self, values: Tensor) -> Tensor:
        """Probability of lying inside, (m,), at given values of all axes (m, A)."""
        columns, outside, width, membership = self._compiled
        reached = ((values[:, columns] - outside) / width).clamp(0, 1)
        union = 1 - (1 - reached @ membership).clamp(0, 1).prod(-1)
        return 1 - union if self.complement else union

    @property
    def description(self) -> Mapping[str, Any]:
        """Rules in words, with the widths of their gaps."""
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
        """Axis, outside and width of every cut, (K,) each, and each cut's weight in its rule, (K, R)."""
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
    """A process on labels +-1 (least-squares classification, Rasmussen and Williams (2006), section 6.5)."""

    definition: EnvironmentDefinition
    process: OutputModel

    def probability(self, q: Tensor) -> Tensor:
        """Probability that q (m, C) lies inside, (m,): that the latent value is above 0."""
        u = q.new_zeros(len(q), self.definition.action.size)
        mean, std = self.process.mean_and_std(encode(self.definition, self.process.feature_map, q, u))
        return likely(mean, std)

    @property
    def description(self) -> Mapping[str, Any]:
        """Description for people."""
        return {"kind": "classifier", "inputs": str(self.process.feature_map)}


Form = Thresholds | Classifier


@dataclass(frozen=True)
class Region:
    """Forms that explain the labels, each with its weight. Where they disagree, the region is uncertain."""

    forms: tuple[tuple[float, Form], ...]  # weights add up to 1
    scores: tuple[tuple[str, float], ...]  # leave-one-out log probability of every form compared

    def probability(self, q: Tensor) -> Tensor:
        """Probability that q (m, C) lies inside, (m,)."""
        mixed = torch.stack([weight * form.probability(q) for weight, form in self.forms]).sum(0)
        return mixed.clamp(0, 1)  # the weights add up to 1 but for rounding

    @property
    def description(self) -> dict[str, Any]:
        """Every form in words, with its score."""
        forms = [{"weight": weight, **form.description} for weight, form in self.forms]
        return {"forms": forms, "scores": dict(self.scores)}


@dataclass(frozen=True)
class Jump:
    """A reward that is higher by ``size`` (lower if negative) inside a region."""

    region: Region
    size: float


def jumped(jumps: Sequence[Jump], q: Tensor) -> tuple[Tensor, Tensor]:
    """Contribution of jumps to the reward of states q (m, C), and its variance from their uncertain edges, (m,) each.

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
    """Probability (m,) that a latent value with this mean and standard deviation is above 0."""
    probability: Tensor = torch.special.ndtr(mean / std.clamp_min(1e-9))
    return probability
