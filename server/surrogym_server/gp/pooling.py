"""Pooling: outputs that are the same function of different inputs learn from each other's samples.

Masses in a row, tanks in series and rooms side by side obey the same law with inputs of their own. If the samples of
several outputs are more likely as those of one function, each of these outputs learns from the samples of all. Evidence
is that of the targets in their own unit, priors of hyperparameters included. The function is first that of the output
that depends on few inputs and is predicted best; for each other output, a search finds which of its inputs correspond
to this function's arguments.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations

import torch
from torch import Tensor

from surrogym_server.gp.kernel import Hyperparameters, Reflection
from surrogym_server.gp.parameters import FitOptions
from surrogym_server.gp.posterior import Posterior, condition
from surrogym_server.gp.search import Evidence, blas, minimum
from surrogym_server.gp.subsets import FEW, spread

Inputs = tuple[int, ...]
# The search for the inputs of one output that correspond to those of another has this many starts, and at most this
# many steps from each start.
STARTS, SWEEPS = 3, 4


@dataclass(frozen=True)
class Part:
    """One output that may share its samples with others in a pool: its exact process, its samples and its unit.

    Attributes:
        x: inputs (n, D).
        y: standardised targets (n,); in the output's unit they are centre + scale y.
        hyper: hyperparameters of the process of all inputs, for standardised targets.
        centre, scale: mean and standard deviation with which the targets were standardised, see ``y``.
        options: options with which the process was fitted.
        reads: indices of the inputs that the output probably depends on, ascending.
        fewer: hyperparameters of the process that reads only the inputs ``reads``.
        signs: (D,) signs of the inputs in the mirror image of the environment, or None if it has no mirror symmetry.
    """

    x: Tensor
    y: Tensor
    hyper: Hyperparameters
    centre: float
    scale: float
    options: FitOptions
    reads: Inputs
    fewer: Hyperparameters
    signs: Tensor | None

    @cached_property
    def alone(self) -> float:
        """Log evidence of this output's targets if it is modelled separately, by the likelier of its two processes:
        that of all inputs, or that of the inputs ``reads``."""
        return max(self.evidence(self.hyper, self.x, self.y), self.evidence(self.fewer, self.read(self.reads), self.y))

    @cached_property
    def posterior(self) -> Posterior:
        """Process that reads only the inputs ``reads``, conditioned on this output's samples."""
        return condition(self.fewer, self.read(self.reads), self.y)

    def read(self, inputs: Inputs) -> Tensor:
        """Return the columns of x that belong to the inputs with these indices, (n, d)."""
        return self.x[:, list(inputs)]

    def targets_of(self, other: Part) -> Tensor:
        """Return the targets (m,) of another part, standardised with this part's centre and scale."""
        return (other.centre + other.scale * other.y - self.centre) / self.scale

    def evidence(self, hyper: Hyperparameters, x: Tensor, y: Tensor) -> float:
        """Return the log evidence, in the output's unit, of targets y (n,) at inputs x (n, d). The targets are
        standardised with this part's centre and scale."""
        objective = Evidence(x, y, self.options, hyper.reflection)
        return -objective(objective.theta(hyper))[0] - len(y) * math.log(self.scale)


@dataclass(frozen=True)
class Pool:
    """Outputs that are modelled as one function.

    Attributes:
        numbers: indices of the pooled parts in the argument ``parts`` of ``pools``.
        parts: the pooled parts. The centre and scale of the first one apply to the common function.
        inputs: for each part, the indices of its inputs that correspond to the arguments of the common function, in the
            order of these arguments.
        hyper: hyperparameters of the common function, in the standardised unit of the first part.
        gain: log evidence of the common function less the sum of those of the separate parts.
    """

    numbers: tuple[int, ...]
    parts: tuple[Part, ...]
    inputs: tuple[Inputs, ...]
    hyper: Hyperparameters
    gain: float

    def samples_of(self, member: int, most: int) -> tuple[Tensor, Tensor, Hyperparameters]:
        """Return inputs (k, d), targets (k,) and hyperparameters of the common function, in the form in which the part
        with index ``member`` uses them.

        The columns of the inputs are in ascending order of the part's input indices. The first rows are all samples of
        the part itself. Samples of the other parts follow, up to ``most`` rows in total. Targets are standardised with
        the part's scale and the first part's centre, which is 0 for an odd function.
        """
        first, own, inputs = self.parts[0], self.parts[member], self.inputs[member]
        back = [inputs.index(place) for place in sorted(inputs)]
        others = [i for i in range(len(self.parts)) if i != member]
        x = torch.cat([self.parts[i].read(self.inputs[i]) for i in others])
        own_targets = replace(own, centre=first.centre)
        y = torch.cat([own_targets.targets_of(self.parts[i]) for i in others])
        rows = spread(len(y), max(0, most - len(own.y)))
        mirror = self.hyper.reflection
        ratio = (first.scale / own.scale) ** 2
        hyper = Hyperparameters(
            self.hyper.lengthscale[back],
            ratio * self.hyper.signal_variance,
            ratio * self.hyper.linear_variance,
            ratio * self.hyper.quadratic_variance,
            ratio * self.hyper.noise_variance,
            None if mirror is None else replace(mirror, signs=mirror.signs[back]),
        )
        return torch.cat([own.read(inputs), x[rows]])[:, back], torch.cat([own_targets.targets_of(own), y[rows]]), hyper


def pools(parts: Sequence[Part], most: int) -> list[Pool]:
    """Group outputs (parts) into pools: outputs whose samples are more likely under one common function than under
    separate functions. Runs on the CPU.

    Each part that probably depends on at most ``most`` inputs may start a pool, in ascending order of the parts'
    leave-one-out errors. Each part that is in no earlier pool may join.

    Raises:
        NumericalFailure: no jitter makes the covariance of a part's points positive definite.
    """
    few = [number for number, part in enumerate(parts) if len(part.reads) <= most]
    free, result = set(range(len(parts))), list[Pool]()
    with blas().limit(limits=1):
        for first in sorted(few, key=lambda number: parts[number].posterior.left_out.error):
            if first not in free:
                continue
            numbers, inputs = [first], [parts[first].reads]
            for other in sorted(free - {first}):
                if (played := _inputs_alike(parts[first], parts[other])) is not None:
                    numbers.append(other)
                    inputs.append(played)
            if len(numbers) > 1:
                result.append(_pooled(numbers, [parts[number] for number in numbers], inputs))
                free -= set(numbers)
    return result


def _inputs_alike(part: Part, other: Part) -> Inputs | None:
    """Return the inputs of ``other`` that correspond to the inputs ``reads`` of ``part``; None if the two parts are
    more likely separate functions.

    All assignments of inputs have the same prior probability. One function and two functions are compared without
    fitting hyperparameters again.
    """
    if part.options != other.options:
        return None
    y = part.targets_of(other)
    played = _played(part.posterior, other.x, y, _may_play(part, other))
    if played is None:
        return None
    x = torch.cat([part.read(part.reads), other.read(played)])
    together = part.evidence(part.fewer, x, torch.cat([part.y, y])) - _orders(other, len(played))
    return played if together > part.alone + other.alone else None


def _orders(other: Part, count: int) -> float:
    """Return the logarithm of the number of ordered choices of ``count`` inputs of a part."""
    return math.log(math.perm(other.x.shape[1], count))


def _may_play(part: Part, other: Part) -> Tensor:
    """Return which of the D inputs of ``other`` may correspond to each of the d inputs that ``part`` reads, (d, D)
    bool. If ``part`` has mirror symmetry, both inputs must have the same sign in a mirror image."""
    mirror: Reflection | None = part.fewer.reflection
    d, size = len(part.reads), other.x.shape[1]
    if mirror is None:
        return torch.ones(d, size, dtype=torch.bool)
    if other.signs is None:
        return torch.zeros(d, size, dtype=torch.bool)
    return mirror.signs[:, None] == other.signs


def _played(process: Posterior, x: Tensor, y: Tensor, may: Tensor) -> Inputs | None:
    """Find the inputs of x (n, D) with which a process predicts targets y (n,) best; None if no choice is allowed.

    The search starts at the inputs that correlate most with the targets. As long as this reduces the mean squared
    error, it replaces a chosen input by another input, or lets two chosen inputs change places. ``may`` (d, D) is true
    where one of the D inputs of x may be used as one of the d inputs of the process.
    """
    d, size = may.shape
    if size < d or not bool(may.any(1).all()):
        return None
    effect = ((x - x.mean(0)).T @ (y - y.mean())).abs() / x.std(0).clamp_min(1e-12)
    strongest = effect.argsort(descending=True)[: d + 1].tolist()
    starts = [choice for choice in permutations(strongest, d) if _may_read(may, choice)]
    if not starts:
        any_allowed = next((choice for choice in permutations(range(size), d) if _may_read(may, choice)), None)
        if any_allowed is None:
            return None
        starts = [any_allowed]
    errors = _errors(process, x, y, starts)
    optima: list[tuple[float, Inputs]] = []
    for place in errors.argsort()[:STARTS].tolist():
        best, error = starts[place], float(errors[place])
        for _ in range(SWEEPS):
            choices = [t for t in _neighbours(best, size) if _may_read(may, t)]
            if not choices or float((again := _errors(process, x, y, choices)).min()) >= error:
                break
            best, error = choices[int(again.argmin())], float(again.min())
        optima.append((error, best))
    return min(optima)[1]


def _neighbours(inputs: Inputs, size: int) -> list[Inputs]:
    """Return all choices of inputs that differ from ``inputs`` in one step: one input is replaced by another of the
    ``size`` inputs, or two inputs change places."""
    swaps = []
    for place, old in enumerate(inputs):
        for new in set(range(size)) - {old}:
            swapped = [old if played == new else played for played in inputs]
            swapped[place] = new
            swaps.append(tuple(swapped))
    return swaps


def _may_read(may: Tensor, inputs: Inputs) -> bool:
    return bool(may[torch.arange(len(inputs)), list(inputs)].all())


def _errors(process: Posterior, x: Tensor, y: Tensor, choices: Sequence[Inputs]) -> Tensor:
    """Return the mean squared errors (t,) with which the process predicts targets y (n,) from each of t choices of d
    columns of x (n, D)."""
    points = torch.cat([x[:, list(inputs)] for inputs in choices])
    return (process.mean(points).view(len(choices), len(y)) - y).square().mean(1)


def _pooled(numbers: Sequence[int], parts: Sequence[Part], inputs: Sequence[Inputs]) -> Pool:
    """Fit the common function of the parts, on a subset of the samples if there are many. ``numbers`` are the indices
    of the parts, and ``inputs`` has for each part those of its inputs that are the arguments of the function."""
    first = parts[0]
    x = torch.cat([part.read(read) for part, read in zip(parts, inputs, strict=True)])
    y = torch.cat([first.targets_of(part) for part in parts])
    rows = spread(len(y), FEW)
    objective = Evidence(x[rows], y[rows], first.options, first.fewer.reflection)
    _, theta = minimum(objective, objective.theta(first.fewer))
    hyper = objective.hyper(theta)
    apart = sum(part.alone for part in parts)
    apart += sum(_orders(part, len(inputs[0])) for part in parts[1:])
    return Pool(tuple(numbers), tuple(parts), tuple(inputs), hyper, first.evidence(hyper, x, y) - apart)
