"""Regions of states, learned from states labelled as inside or outside: where episodes end, and where a reward jumps.

A region is a weighted mean of forms of two kinds. ``Thresholds``: a state is inside if it exceeds any of several
thresholds on single axes, or, in the complement, none of them. A threshold is known up to the gap between the nearest
samples outside and inside. ``Classifier``: a Gaussian process fitted to labels 1 (inside) and -1 (outside).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import encode
from surrogym_server.environment.terms import TermSet, compile_terms, parts_of
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.tensors import cached, to_device
from surrogym_shared.spec import Term

TERMINATION = "termination"  # name of the region where episodes end, in keys of warm starts and of stored arrays
Side = Literal["above", "below", "beyond"]  # side of a threshold on a value t: t > level, -t > level, or |t| > level
SIDES: tuple[Side, ...] = ("above", "below", "beyond")


@dataclass(frozen=True)
class Axes:
    """Axes on which a learned threshold can lie: x, -x and |x| for each x among T coordinates and observation entries,
    A = 3 T axes in total."""

    names: tuple[str, ...]  # (T,) names of the T coordinates and observation entries to which the axes belong
    terms: TermSet

    @classmethod
    def of(cls, definition: EnvironmentDefinition) -> Axes:
        """Build the axes for the moving coordinates, and for those observation entries that differ from all of these
        coordinates."""
        coordinates = definition.coordinate_names
        shown = [(c.name, c.term) for c in definition.coordinates if c.moves]
        shown += [(entry.name, entry.term) for entry in definition.observation]
        different: dict[object, tuple[str, Term]] = {}
        for name, term in shown:
            different.setdefault((parts_of(term, coordinates), term.low, term.high), (name, term))
        names, terms = zip(*different.values(), strict=True)
        return cls(names, to_device(compile_terms(terms, coordinates), definition.device))

    def __len__(self) -> int:
        return 3 * len(self.names)

    def __call__(self, q: Tensor) -> Tensor:
        """Return the values (m, A) of states q (m, C) on all A axes."""
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
    """Threshold on one axis of the state space. A state lies inside a region if its value on the axis exceeds the
    threshold, which is only known to lie between ``outside`` and ``inside``."""

    axis: int
    outside: float  # greatest value on the axis of all samples outside the region
    inside: float  # least value on the axis of those samples inside the region that this threshold explains
    weight: float  # probability of this threshold among the alternatives of its rule


@dataclass(frozen=True)
class Thresholds:
    """Region of the states for which any rule holds. A rule consists of alternative thresholds (cuts), each with its
    probability. Only one of them is right, but all explain the same samples."""

    definition: EnvironmentDefinition
    rules: tuple[tuple[Cut, ...], ...]
    complement: bool = False  # if true, the region consists of the states for which no rule holds

    def probability(self, q: Tensor) -> Tensor:
        """Return the probability (m,) that states q (m, C) lie inside. Each threshold is uniformly distributed over the
        gap between the nearest samples outside and inside."""
        return self.at(self._axes(q))

    def at(self, values: Tensor) -> Tensor:
        """Return the probability that m states lie inside, (m,), given their values on all axes (m, A)."""
        columns, outside, width, membership = self._compiled
        reached = ((values[:, columns] - outside) / width).clamp(0, 1)
        union = 1 - (1 - reached @ membership).clamp(0, 1).prod(-1)
        return 1 - union if self.complement else union

    @property
    def description(self) -> Mapping[str, Any]:
        """The rules as values for JSON: the inequality of each threshold in words, the gap in which the threshold lies,
        and its weight."""
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
        """Tensors of all K cuts (thresholds): axis, lower end of the gap in which the threshold lies, and width of the
        gap, (K,) each; and the weight of each cut in each of the R rules, (K, R), 0 in rules without it."""
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
    """Region learned by a Gaussian process that is fitted to labels, 1 inside and -1 outside (least-squares
    classification, Rasmussen and Williams (2006), section 6.5)."""

    definition: EnvironmentDefinition
    process: OutputModel

    def probability(self, q: Tensor) -> Tensor:
        """Return the probability (m,) that states q (m, C) lie inside: that the process is above 0 there."""
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
    """Learned region of states: a weighted mean of forms (thresholds or a classifier) that each explain which samples
    lie inside. Where the forms disagree, the probability of being inside lies between 0 and 1."""

    # Pairs of a weight and a form (thresholds or a classifier) of the region; the weights add up to 1.
    forms: tuple[tuple[float, Form], ...]
    # Name and leave-one-out log probability of each form (thresholds or a classifier) that was compared.
    scores: tuple[tuple[str, float], ...]

    def probability(self, q: Tensor) -> Tensor:
        """Return the probability (m,) that states q (m, C) lie inside the region."""
        mixed = torch.stack([weight * form.probability(q) for weight, form in self.forms]).sum(0)
        return mixed.clamp(0, 1)  # because of rounding, the weighted sum may exceed 1

    @property
    def description(self) -> dict[str, Any]:
        """All forms of the region and their scores, as values for JSON."""
        forms = [{"weight": weight, **form.description} for weight, form in self.forms]
        return {"forms": forms, "scores": dict(self.scores)}


@dataclass(frozen=True)
class Jump:
    """Jump of the reward: a region of states inside which the reward is higher by ``size``, or lower if ``size`` is
    negative."""

    region: Region
    size: float


def jumped(jumps: Sequence[Jump], q: Tensor) -> tuple[Tensor, Tensor]:
    """Return the amounts (m,) that jumps add to the reward of states q (m, C), and the variances (m,) of these amounts,
    which are above 0 where it is uncertain whether a state lies inside.

    If a state lies inside the regions of several jumps, only the first of these jumps counts.
    """
    added, variance, free = q.new_zeros(len(q)), q.new_zeros(len(q)), q.new_ones(len(q), dtype=torch.bool)
    for jump in jumps:
        inside = jump.region.probability(q)
        added = added + jump.size * ((inside > 0.5) & free)
        variance = variance + jump.size**2 * inside * (1 - inside) * free
        free = free & (inside <= 0.5)
    return added, variance


def likely(mean: Tensor, std: Tensor) -> Tensor:
    """Return the probability (m,) that a normal variable is above 0, for each mean (m,) and standard deviation ``std``
    (m,)."""
    probability: Tensor = torch.special.ndtr(mean / std.clamp_min(1e-9))
    return probability
