"""Fit of one output: its scaling, and the choice of its feature map by evidence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import FeatureMap
from surrogym_server.gp import (
    Censored,
    FitOptions,
    Fitted,
    Posterior,
    Selection,
    condition_many,
    fit,
    fit_bound,
    fit_some,
    fit_through_few,
    loses_nothing,
    refine,
    refine_where_hard,
    spread,
    subsets,
)
from surrogym_server.models.gaussian_process.feature_maps import reflection
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.models.gaussian_process.prediction.warp import PEAK_NOISE
from surrogym_server.models.gaussian_process.settings import Settings
from surrogym_server.models.port import Warm
from surrogym_shared.spec import REWARD

# Prior log odds of four kinds of feature maps (encodings of state and action). A map that reads the lead (next value of
# a leading coordinate) is likelier, because it is also right where a limit cuts a step off. A map that reads nothing
# but the lead is less likely, because it can explain few samples by noise alone. A map with a parity (mirror symmetry)
# is less likely, because samples on one side are no evidence for symmetry. A map without the action is likelier,
# because a reward that is 0 except in one place seldom depends on the action.
LEAD_ODDS, ALONE_ODDS, PARITY_ODDS, PLACE_ODDS = 3.0, -6.0, -3.0, 3.0
CONSTANT = 1e-9  # an output whose standard deviation is at most this share of its absolute mean counts as constant
SMALLEST = 1e-100  # an output with a smaller standard deviation counts as constant, because its square would underflow
PEAK = "reward peak"  # name of the reward's output while the logarithm of the reward is learned
# If the leave-one-out error is at most this, in standard deviations of the targets, the process predicts well enough,
# so that no other inputs or hyperparameters are searched for.
EXPLAINED = 0.01


@dataclass
class OutputLearner:
    """Fitter of the outputs of one model. It stores the hyperparameters of all its fits, at which fits to further
    samples can start (warm start)."""

    definition: EnvironmentDefinition
    settings: Settings
    warm: Warm  # logarithms of hyperparameters from the previous model's fits, by "output|feature map"
    thetas: dict[str, NDArray[np.float64]]  # logarithms of hyperparameters from this model's fits, by the same keys
    # For each output, by name, of which it was tested which inputs can be left out: the best subset of inputs, and its
    # fit.
    selections: dict[str, Selection] = field(default_factory=dict)

    def allowed(self, maps: tuple[FeatureMap, ...]) -> tuple[FeatureMap, ...]:
        """Return those feature maps (encodings of state and action) that the settings allow."""
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
        """Fit one output with each candidate feature map, and return the fit with the greatest evidence.

        All maps are compared on the same samples. First the maps that read all lags (coordinates that repeat past
        values) are fitted, then the best of them with fewer past values.

        Args:
            name: name of the output.
            target: targets (n,).
            inputs: features (n, d) of the samples for each candidate feature map (encoding of state and action).
            keep: (n,) bool, the samples to learn from.
            keep_lead: (n,) bool, the samples to learn from if the best map reads a lead (next value of another
                coordinate).
            side: (n,) 1 for a sample that ended at the output's own upper limit, -1 at the lower, otherwise 0. If there
                are many samples, those outside ``keep`` help to choose hyperparameters.
        """
        centre, scale = float(target[keep].mean()), float(target[keep].std(correction=0))
        if scale <= max(CONSTANT * abs(centre), SMALLEST):
            return OutputModel(name, next(iter(inputs)), None, centre, 1.0, int((~keep).sum()))
        around = {m: 0.0 if m.parity == "odd" else centre for m in inputs}
        fits: dict[FeatureMap, Fitted] = {}

        def better(*maps: FeatureMap) -> FeatureMap:
            """Fit the output with each of the maps. Return the map with the greatest evidence of all fitted so far."""
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
        """Fit a process to x (n, d), y (n,). If there are many points, fit it to a subset, and scale its log evidence
        up to the number of all points. The hyperparameters are stored under a key, for the warm start of later fits;
        ``also`` is appended to this key."""
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
        """Fit the process of an output to more than ``subsets.FEW`` points x (n, d), y (n,), both standardised.

        With the setting ``inducing``, hyperparameters maximise the variational bound of the evidence of all samples.
        Without it, they are fitted to subsets of the samples. With more than ``gp.sparse.MAX_EXACT`` (2,000) points the
        process then has inducing points, and if its leave-one-out errors are large, hyperparameters fitted to the
        points with the largest errors are tried too. With fewer points the process is exact, unless inducing points
        lose no accuracy, see ``gp.variational_bound.loses_nothing``.

        Args:
            name: name of the output.
            feature_map: its encoding of state and action.
            theta: logarithms of hyperparameters that were fitted to a subset of the points.
            at_limit: points at which only a bound of the function is known, or None; without ``inducing`` they may help
                to choose hyperparameters.

        Raises:
            NumericalFailure: no jitter makes the covariance of the points positive definite.
        """
        mirror, options = reflection(self.definition, feature_map), self.options(name)
        if self.settings.inducing:
            return fit_bound(x, y, options, theta, self.settings.inducing, mirror)
        theta = fit_some(x, y, options, theta, mirror)
        if (through_few := fit_through_few(x, y, options, theta, mirror)) is not None:
            return through_few
        posterior = condition_many(refine(x, y, options, theta, mirror), x, y, at_limit)
        if posterior.sparse is None or posterior.left_out.error <= EXPLAINED:
            return posterior
        return condition_many([refine_where_hard(posterior, x, y, options)], x, y, at_limit, earlier=posterior)

    def options(self, name: str) -> FitOptions:
        """Return the options of an output's fit. By default the kernel of every output has a linear part, and that of
        rewards also a quadratic part."""
        options = FitOptions(quadratic=name in (REWARD, PEAK))
        if self.settings.kernel == "squared_exponential":
            options = FitOptions(linear=False)
        return replace(options, noise_floor=PEAK_NOISE) if name == PEAK else options


def is_unexplained(posterior: Posterior) -> bool:
    """Return whether a search for a better structure, for example other inputs, is worthwhile.

    A search is not worthwhile if the process predicts each sample well from the others, or if its inducing points lose
    accuracy.
    """
    return loses_nothing(posterior) and posterior.left_out.error > EXPLAINED


def _with_whole_history(inputs: Mapping[FeatureMap, Tensor]) -> list[FeatureMap]:
    """Return the feature maps that read all lags (coordinates that repeat past values); if there are none, all maps."""
    return [m for m in inputs if m.history is None] or list(inputs)


def _odds(feature_map: FeatureMap) -> float:
    alone = feature_map.state == "none"
    odds = LEAD_ODDS * feature_map.lead + ALONE_ODDS * alone + PARITY_ODDS * bool(feature_map.parity)
    return odds + PLACE_ODDS * (feature_map.action == "none")
