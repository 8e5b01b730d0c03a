"""The promise: the interval in which the surrogate expects a policy's mean real return."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.port import SurrogatePort
from surrogym_shared.wire import OF_PARTICLES
from surrogym_trainer.evaluation.imagined import imagine
from surrogym_trainer.policies.evidence import FallbackShare, Promise
from surrogym_trainer.policies.predict import Predict

# A promise (predicted interval of the mean return) is computed along this number of functions drawn from the posterior.
FUNCTIONS = 32
STARTS = 8  # number of virtual episodes along each drawn function
EVALUATION_STARTS = 100  # a promise predicts the mean return of this number of real episodes
LOW, HIGH = 0.05, 0.95
# an audit (real steps that test the model) does not notice errors that change the return by less than this share of the
# policy's gain over an untrained policy
UNNOTICED = 0.02
NORMAL_POINTS = 201  # number of quantiles that represent a normal distribution

Array = NDArray[np.float64]


def promise_of(
    port: SurrogatePort,
    predict: Predict,
    seed: int,
    session: Mapping[str, Any] | None = None,
    floor: float | None = None,
) -> Promise:
    """Compute a policy's promise: the interval of its mean return over functions drawn from the model's posterior.
    Episodes follow each function from several starts, without any penalty.

    Args:
        port: the interface of the surrogate.
        predict: the policy; function from observations (N, D) to actions.
        seed: seed of functions and starts.
        session: fields of ``OpenSession`` that the policy was trained with. The fields ``variant`` and
            ``penalty``, and those of particles, are ignored.
        floor: return of an untrained policy; None if it was not measured.
    """
    left_out = {"variant", "penalty", *OF_PARTICLES}
    options = {name: value for name, value in (session or {}).items() if name not in left_out}
    options |= {"variant": "pathwise", "functions": FUNCTIONS, "penalty": 0.0}
    imagined = imagine(port, predict, FUNCTIONS * STARTS, seed, **options)
    # lane i of the session follows function i modulo FUNCTIONS, so each column has the returns along one function
    promise = interval(imagined.returns.reshape(STARTS, FUNCTIONS), floor)
    spec = port.spec()
    if imagined.left is None or spec.limits is None or spec.outside_reward is not None:
        return promise
    return promise.model_copy(update={"fallback": fallback_share(imagined.left.reshape(STARTS, FUNCTIONS))})


def fallback_share(fallen: NDArray[np.bool_]) -> FallbackShare:
    """Predict the share of 100 real episodes in which the fallback of declared limits will act.

    The function ``interval`` computes the prediction, with 1 as the return of a virtual episode in which the fallback
    acts, and 0 as that of any other. Often all episodes along one function have a fallback and those along the others
    none. Then the quantiles say little, so the interval always contains the mean. If no virtual episode has a fallback,
    or all have one, the interval ends at the exact one-sided 95 % bound of the share of such functions.

    Args:
        fallen: mask (starts, functions) of the virtual episodes in which the fallback acts.
    """
    share = interval(fallen.astype(np.float64))
    mean = float(fallen.mean())
    # share of functions with a fallback at which, with a probability of 5 %, none of those drawn has one
    bound = 1 - (1 - HIGH) ** (1 / fallen.shape[1])
    high = max(share.high, mean, bound if not fallen.any() else 0.0)
    low = min(share.low, mean, 1 - bound if fallen.all() else 1.0)
    return FallbackShare(mean=mean, median=share.median, low=low, high=high)


def interval(returns: Array, floor: float | None = None) -> Promise:
    """Compute the promise from the returns (starts, functions) of virtual episodes.

    The mean returns of the functions also differ by chance, because each is the mean over a few starts. So they are
    shrunk towards their common mean, until their variance is the part that the functions alone explain (one-way
    analysis of variance). Then the uncertainty of 100 real starts, and that of the virtual starts, is added.

    All functions share the errors of the model's form: for example, a kink is smooth in each of them. So the interval
    also contains an error of the return that is too small for an audit to notice. It is normally distributed; its 95 %
    quantile is ``UNNOTICED`` times the gain over ``floor``, the return of an untrained policy. The mean return is
    limited to the range of the single episodes' returns.
    """
    parts = _parts(returns)
    starts, functions = returns.shape
    chance = parts.within * np.sqrt(1 / EVALUATION_STARTS + 1 / returns.size)
    allowed = UNNOTICED * abs(float(returns.mean()) - (floor or 0.0)) / NormalDist().inv_cdf(HIGH)
    samples = parts.functions[:, None] + np.hypot(chance, allowed) * _normal_points()
    low, median, high = np.quantile(samples.clip(returns.min(), returns.max()), [LOW, 0.5, HIGH]).tolist()
    return Promise(median=median, low=low, high=high, functions=functions, episodes=starts * functions)


class _Parts(NamedTuple):
    """The variation of the returns of virtual episodes, split into the variation between drawn functions and the
    variation between starts."""

    # (S,) mean return along each of S drawn functions, shrunk so that their variance has no part due to the starts
    functions: Array
    within: float  # standard deviation of the returns along one function, which differ by their starts


def _parts(returns: Array) -> _Parts:
    means = returns.mean(0)
    within = float(returns.var(0, ddof=1).mean())
    observed = float(means.var(ddof=1))
    explained = max(observed - within / len(returns), 0.0)
    scale = np.sqrt(explained / observed) if observed > 0 else 0.0
    # widens the spread to first order as Student's t distribution does, because the plant is a further function that
    # was not drawn
    scale *= 1 + 1.5 / len(means)
    return _Parts(means.mean() + scale * (means - means.mean()), float(np.sqrt(within)))


@cache
def _normal_points() -> Array:
    """Return standard normal quantiles at equal probabilities."""
    standard = NormalDist()
    return np.array([standard.inv_cdf((i + 0.5) / NORMAL_POINTS) for i in range(NORMAL_POINTS)])
