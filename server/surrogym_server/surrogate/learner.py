"""Fitting one output: its scaling, and the choice of its feature map by evidence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.gp import FitOptions, Fitted, condition_sparse, fit, spread
from surrogym_server.surrogate.definition import REWARD, EnvironmentDefinition
from surrogym_server.surrogate.features import FeatureMap
from surrogym_server.surrogate.model import OutputModel

Thetas = Mapping[str, NDArray[np.float64]]  # "output|feature map" -> hyperparameters, for warm starts
CONSTANT = 1e-9  # an output whose deviation is below this share of its own size never varied


@dataclass
class Learner:
    """Fits processes, each from its warm start, and keeps their hyperparameters."""

    definition: EnvironmentDefinition
    warm: Thetas
    thetas: dict[str, NDArray[np.float64]]

    def output(
        self, name: str, target: Tensor, inputs: Mapping[FeatureMap, Tensor], keep: Tensor, keep_lead: Tensor
    ) -> OutputModel:
        """The best of the feature maps ``inputs`` (n, d) for one output's targets (n,).

        ``keep`` (n,) marks the samples that count. Maps that read the lead may use more, ``keep_lead``; all are
        compared on the same points.
        """
        centre, scale = float(target[keep].mean()), float(target[keep].std(correction=0))
        if scale <= CONSTANT * abs(centre):
            return OutputModel(name, next(iter(inputs)), None, centre, 1.0, int((~keep).sum()))
        y = (target - centre) / scale
        fits = {m: self._fit(f"{name}|{m}", x[keep], y[keep]) for m, x in inputs.items()}
        best = max(fits, key=lambda m: fits[m].score)
        chosen, used = fits[best], keep
        if best.lead and bool((keep_lead & ~keep).any()):
            used = keep_lead
            chosen = self._fit(f"{name}|{best}|all", inputs[best][used], y[used])
        scores = tuple((str(m), f.score) for m, f in fits.items())
        posterior = chosen.posterior
        if len(posterior.y) < int(used.sum()):
            posterior = condition_sparse(posterior.hyper, inputs[best][used], y[used])
        return OutputModel(name, best, posterior, centre, scale, int((~used).sum()), scores)

    def _fit(self, key: str, x: Tensor, y: Tensor) -> Fitted:
        """Fit to all points; of very many, to some of them, and score as if all were alike."""
        options, rows = self._options(key), spread(len(y))
        fitted = fit(x[rows], y[rows], options, self.warm.get(key))
        self.thetas[key] = fitted.theta
        return replace(fitted, score=fitted.score * len(y) / len(rows))

    def _options(self, key: str) -> FitOptions:
        """Dynamics tend to be near linear, costs to be quadratic; the paper has the squared exponential alone."""
        if self.definition.design.preset == "paper":
            return FitOptions(linear=False)
        return FitOptions(quadratic=key.startswith(f"{REWARD}|"))
