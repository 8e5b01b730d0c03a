"""Processes that are alike: the samples of one are further samples of another, with inputs of their own.

Masses in a row, tanks in series and rooms side by side do the same with inputs of their own. If their samples are far
more likely as those of one function, all of them learn from all samples. Evidence is that of the targets in their own
unit, priors of hyperparameters included. The function is known best from one of the processes, which reads few inputs;
for another one, a search looks which of its inputs play the same parts.
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
STARTS, SWEEPS = 3, 4  # of a search for the inputs that play the parts of others


@dataclass(frozen=True)
class Part:
    """An exact process and its samples.

    Attributes:
        x: inputs (n, D).
        y: standardised targets (n,); in their unit they are centre + scale y.
        hyper: hyperparameters, in the unit of y.
        centre, scale: see ``y``.
        options: those of the fit.
        reads: places of the inputs that the process probably reads, ascending.
        fewer: hyperparameters of the process that reads these alone.
        signs: (D,) signs of the inputs in a mirror image of everything, or None if there is none.
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
        """Log evidence of the targets without other samples."""
        return max(self.evidence(self.hyper, self.x, self.y), self.evidence(self.fewer, self.read(self.reads), self.y))

    @cached_property
    def posterior(self) -> Posterior:
        """The process that reads few inputs."""
        return condition(self.fewer, self.read(self.reads), self.y)

    def read(self, inputs: Inputs) -> Tensor:
        """Some of the inputs, (n, d)."""
        return self.x[:, list(inputs)]

    def targets_of(self, other: Part) -> Tensor:
        """The targets (m,) of another part, standardised as those of this one."""
        return (other.centre + other.scale * other.y - self.centre) / self.scale

    def evidence(self, hyper: Hyperparameters, x: Tensor, y: Tensor) -> float:
        """Log evidence of targets (n,) at inputs (n, d), standardised as this part's, in the targets' unit."""
        objective = Evidence(x, y, self.options, hyper.reflection)
        return -objective(objective.theta(hyper))[0] - len(y) * math.log(self.scale)


@dataclass(frozen=True)
class Pool:
    """Parts that are one function.

    Attributes:
        numbers: those of the parts, in the sequence that was given. The first one gives the unit.
        parts: the parts.
        inputs: for each part, its inputs in the order in which the function reads them.
        hyper: hyperparameters of the function, in the unit of the first part.
        gain: log evidence above that of the parts alone.
    """

    numbers: tuple[int, ...]
    parts: tuple[Part, ...]
    inputs: tuple[Inputs, ...]
    hyper: Hyperparameters
    gain: float

    def samples_of(self, member: int, most: int) -> tuple[Tensor, Tensor, Hyperparameters]:
        """Inputs (k, d), ascending, and targets (k,) of all parts, and the hyperparameters, as one part sees them.

        Its own samples come first, and all of them. Of the others there are as many as fit into ``most``. Targets have
        the part's scale around the first part's centre: that of an odd function is 0.
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
    """Put parts together whose samples are more likely together.

    The parts that are known best come first, and others join them. Only a part that probably reads at most ``most``
    inputs is joined by others. Runs on the CPU. Raises ``NumericalFailure``.
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
    """The inputs of another part that play the same parts; None if its samples are more likely apart.

    Every order of inputs is equally likely before any data. Hyperparameters stay as they are.
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
    """Logarithm of the number of ways in which a part's inputs can play ``count`` parts."""
    return math.log(math.perm(other.x.shape[1], count))


def _may_play(part: Part, other: Part) -> Tensor:
    """Which inputs of another part may play each of the part's, (d, D) bool: those with the same sign in a mirror
    image."""
    mirror: Reflection | None = part.fewer.reflection
    d, size = len(part.reads), other.x.shape[1]
    if mirror is None:
        return torch.ones(d, size, dtype=torch.bool)
    if other.signs is None:
        return torch.zeros(d, size, dtype=torch.bool)
    return mirror.signs[:, None] == other.signs


def _played(process: Posterior, x: Tensor, y: Tensor, may: Tensor) -> Inputs | None:
    """Inputs of x (n, D) with which a process predicts targets (n,) best, found by exchanging one of them, or two with
    each other, as long as this helps.

    The search begins at inputs that vary most with the targets. ``may`` (d, D) says which input may play which part.
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
    """The inputs with one exchanged for another of all ``size``, or with two in each other's place."""
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
    """Mean squared error of targets (n,) for each choice of inputs, (t,)."""
    points = torch.cat([x[:, list(inputs)] for inputs in choices])
    return (process.mean(points).view(len(choices), len(y)) - y).square().mean(1)


def _pooled(numbers: Sequence[int], parts: Sequence[Part], inputs: Sequence[Inputs]) -> Pool:
    """Fit the one function, on some of the samples if they are many."""
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
