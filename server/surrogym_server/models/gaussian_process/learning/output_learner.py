"""Fit of one output: its scaling, and the choice of its feature map by evidence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.environment.definition import REWARD, EnvironmentDefinition
from surrogym_server.environment.features import FeatureMap
from surrogym_server.gp import Censored, FitOptions, Fitted, Posterior, Selection, fit, loses_nothing, spread, subsets
from surrogym_server.models.gaussian_process.feature_maps import reflection
from surrogym_server.models.gaussian_process.learning.many import EXPLAINED, BySubsets, ManySamples
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.models.gaussian_process.prediction.warp import PEAK_NOISE
from surrogym_server.models.gaussian_process.settings import Settings
from surrogym_server.models.port import Warm

# Log odds of maps before any data. A map that reads the lead fits no better where nothing was cut, and alone is right
# where something is; few samples look like noise over the lead alone; and what is seen of one side alone says nothing
# of the other, mirrored or not. What pays in one place alone seldom asks for the action as well.
LEAD_ODDS, ALONE_ODDS, PARITY_ODDS, PLACE_ODDS = 3.0, -6.0, -3.0, 3.0
CONSTANT = 1e-9  # an output whose standard deviation is below this share of its own size never varied
SMALLEST = 1e-100  # standard deviation of an output: squares of a smaller one underflow
PEAK = "reward peak"  # the logarithm of a reward


@dataclass
class OutputLearner:
    """Fits processes, each from its warm start, and keeps their hyperparameters."""

    definition: EnvironmentDefinition
    settings: Settings
    warm: Warm  # hyperparameters of earlier fits by "output|feature map"
    thetas: dict[str, NDArray[np.float64]]  # hyperparameters of this fit
    many: ManySamples = field(default_factory=BySubsets)  # what is done with more than ``subsets.FEW`` samples
    selections: dict[str, Selection] = field(default_factory=dict)  # inputs that evidence alone keeps, by output

    def allowed(self, maps: tuple[FeatureMap, ...]) -> tuple[FeatureMap, ...]:
        """The maps that the settings allow to compare."""
        return tuple(m for m in maps if self.settings.symmetry == "auto" or not m.parity)

    def output(
        self,
        name: str,
        target: Tensor,
        inputs: Mapping[FeatureMap, Tensor],
        keep: Tensor,
        keep_lead: Tensor,
        side: Tensor | None = None,
    ) -> OutputModel:
        """Fit one output's targets (n,) with each of the feature maps ``inputs`` (n, d), and return the best.

        ``keep`` (n,) marks the samples that count. Maps that read the lead may use more, ``keep_lead``. All are
        compared on the same points. The maps with all lags are compared first, and then the histories of the best one.
        ``side`` (n,) is 1 for a sample that ended at the output's own upper limit, -1 at the lower, else 0. Of those
        that do not count, these help to choose hyperparameters if the samples are many.
        """
        centre, scale = float(target[keep].mean()), float(target[keep].std(correction=0))
        if scale <= max(CONSTANT * abs(centre), SMALLEST):
            return OutputModel(name, next(iter(inputs)), None, centre, 1.0, int((~keep).sum()))
        around = {m: 0.0 if m.parity == "odd" else centre for m in inputs}
        fits: dict[FeatureMap, Fitted] = {}

        def better(*maps: FeatureMap) -> FeatureMap:
            """The best of the maps, and of those fitted before."""
            fits.update({m: self._fit(name, m, inputs[m][keep], (target[keep] - around[m]) / scale) for m in maps})
            return max(fits, key=lambda m: fits[m].score + _odds(m))

        whole = _with_whole_history(inputs)
        best = better(*whole)
        best = better(*(m for m in inputs if m not in whole and replace(m, history=best.history) == best))
        best_fit, centre = fits[best], around[best]
        y = (target - centre) / scale
        more = bool(best.lead) and bool((keep_lead & ~keep).any())
        rows = keep_lead if more else keep
        if int(rows.sum()) > subsets.FEW:
            rest = None if side is None else ((side != 0) & ~rows)
            at_limit = None if side is None else Censored(inputs[best][rest], y[rest], side[rest])
            posterior = self.refined(name, best, inputs[best][rows], y[rows], best_fit.theta, at_limit)
        elif more:
            posterior = self._fit(name, best, inputs[best][rows], y[rows], "|all").posterior
        else:
            posterior = best_fit.posterior
        scores = tuple((str(m), f.score) for m, f in fits.items())
        return OutputModel(name, best, posterior, centre, scale, int((~rows).sum()), scores)

    def _fit(self, name: str, feature_map: FeatureMap, x: Tensor, y: Tensor, also: str = "") -> Fitted:
        """Fit to all points. If there are many, fit to some of them, and scale the score as if the others
        were alike."""
        key, rows = f"{name}|{feature_map}{also}", spread(len(y), subsets.FEW)
        mirror = reflection(self.definition, feature_map)
        result = fit(x[rows], y[rows], self.options(name), self.warm.get(key), mirror)
        self.thetas[key] = result.theta
        return replace(result, score=result.score * len(y) / len(rows))

    def refined(
        self,
        name: str,
        feature_map: FeatureMap,
        x: Tensor,
        y: Tensor,
        theta: NDArray[np.float64],
        at_limit: Censored | None = None,
    ) -> Posterior:
        """The process of all points x (n, d), y (n,); ``theta`` was fitted to a subset."""
        mirror = reflection(self.definition, feature_map)
        return self.many.fitted(x, y, self.options(name), theta, mirror, at_limit)

    def options(self, name: str) -> FitOptions:
        """Dynamics tend to be near linear, and costs to be quadratic."""
        options = FitOptions(quadratic=name in (REWARD, PEAK))
        if self.settings.kernel == "squared_exponential":
            options = FitOptions(linear=False)
        return replace(options, noise_floor=PEAK_NOISE) if name == PEAK else options


def is_unexplained(posterior: Posterior) -> bool:
    """Whether other structures of a process are worth a search.

    They are not if it predicts each sample well from the others. They are not either where inducing points stand for
    the samples, and lose something.
    """
    return loses_nothing(posterior) and posterior.left_out.error > EXPLAINED


def _with_whole_history(inputs: Mapping[FeatureMap, Tensor]) -> list[FeatureMap]:
    """The maps that read all lags, or if there is none, the only history that is given."""
    return [m for m in inputs if m.history is None] or list(inputs)


def _odds(feature_map: FeatureMap) -> float:
    alone = feature_map.state == "none"
    odds = LEAD_ODDS * feature_map.lead + ALONE_ODDS * alone + PARITY_ODDS * bool(feature_map.parity)
    return odds + PLACE_ODDS * (feature_map.action == "none")
