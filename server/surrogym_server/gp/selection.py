"""Selection of inputs: a process leaves out inputs if its samples are about as likely without them, or likelier.

A long length scale takes an input out of the squared exponential, but not out of the linear part, whose variance all
inputs share, and few points have to determine each further length scale. So inputs are eliminated one after the other:
each time the input without which the log evidence, priors of hyperparameters included, is greatest. This ends when the
log evidence decreases too much. Reference: Rasmussen and Williams (2006), section 5.1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surrogym_server.gp.kernel import Hyperparameters
from surrogym_server.gp.parameters import Array, FitOptions
from surrogym_server.gp.posterior import Posterior
from surrogym_server.gp.search import Evidence, blas, minimum


@dataclass(frozen=True)
class Selection:
    """Result of eliminating inputs of a process: a process that reads only some of the inputs."""

    mask: Tensor  # (d,) bool, true for the inputs that the process reads
    theta: Array  # logarithms of the hyperparameters of the process
    score: float  # log evidence of the process, priors of hyperparameters included
    gain: float  # log evidence of the process less that of the process with all inputs
    hyper: Hyperparameters


def select_inputs(posterior: Posterior, options: FitOptions, may: Tensor, odds: float) -> Selection:
    """Leave out inputs of an exact process, one after the other, as long as the log evidence does not decrease by more
    than ``odds`` for an input. Runs on the CPU.

    Args:
        posterior: the process with all inputs, and its points.
        options: options with which the process was fitted.
        may: (d,) bool, true for each input that may be left out. At least one input is kept.
        odds: prior log odds of leaving out one more input. An input is left out if the log evidence decreases by at
            most this number; if it is negative, the log evidence has to increase by that much.
    """
    search = _Search(posterior, options, may)
    with blas().limit(limits=1):
        whole = subset = search.whole()
        while (less := search.without_one(subset, subset.cost + odds)) is not None:
            subset = less
        subset = search.fitted(subset)
    hyper = search.objective(subset.mask).hyper(subset.theta)
    return Selection(subset.mask, subset.theta, -subset.cost, whole.cost - subset.cost, hyper)


@dataclass(frozen=True)
class _Subset:
    mask: Tensor  # (d,) bool, true for the inputs in the subset
    theta: Array
    cost: float  # negative log evidence, priors included


class _Search:
    """Search over the subsets of the inputs of a process."""

    def __init__(self, posterior: Posterior, options: FitOptions, may: Tensor) -> None:
        self._posterior, self._options, self._may = posterior, options, may

    def objective(self, mask: Tensor) -> Evidence:
        mirror = self._posterior.hyper.reflection
        part = None if mirror is None else replace(mirror, signs=mirror.signs[mask])
        return Evidence(self._posterior.x[:, mask], self._posterior.y, self._options, part)

    def whole(self) -> _Subset:
        """Return the subset of all inputs with its fitted hyperparameters. The fit starts at those of the process,
        which may have been fitted to other points."""
        mask = torch.ones_like(self._may)
        theta = self.objective(mask).theta(self._posterior.hyper)
        return self.fitted(_Subset(mask, theta, 0.0))

    def fitted(self, subset: _Subset) -> _Subset:
        """Return the subset with hyperparameters fitted to its inputs."""
        cost, theta = minimum(self.objective(subset.mask), subset.theta)
        return replace(subset, theta=theta, cost=cost)

    def without_one(self, subset: _Subset, most: float) -> _Subset | None:
        """Return the subset with one input less that has the lowest cost (negative log evidence), or None if this cost
        is above ``most``.

        Its hyperparameters are fitted again only if the cost with the hyperparameters of ``subset`` is above ``most``.
        """
        best = min(self._each_without_one(subset), key=lambda less: less.cost, default=None)
        if best is not None and best.cost > most:
            best = self.fitted(best)
        return best if best is not None and best.cost <= most else None

    def _each_without_one(self, subset: _Subset) -> Iterator[_Subset]:
        """Yield each subset with one input less, with the hyperparameters of ``subset``. Skip a subset of inputs of
        which only the zero function has the symmetry of the process."""
        mirror, places = self._posterior.hyper.reflection, subset.mask.nonzero()[:, 0].tolist()
        for position, place in enumerate(places):
            mask = subset.mask.clone()
            mask[place] = False
            nothing = mirror is not None and mirror.parity < 0 and bool((mirror.signs[mask] > 0).all())
            if self._may[place] and bool(mask.any()) and not nothing:
                theta = subset.theta[torch.arange(len(subset.theta)).numpy() != position]
                yield _Subset(mask, theta, self.objective(mask)(theta)[0])
