"""Learning from samples that ended at a limit of a coordinate.

Limits of other coordinates: a limit may or may not change the rest of the step. A wall stops the speed, but a relief
valve at its pressure limit does not influence the concentration. Without samples at such limits, the process of an
output has to extrapolate there. So one process is fitted with them and another without. The process with the smaller
error over all these samples is used, where each sample is predicted from the others.

The output's own limit: without the limit, the step would have gone at least as far, so the sample is an inequality. If
the process predicts a step beyond the limit, the sample is not used. If the process predicts less, the sample becomes
an observation of the limit itself. The samples that become observations are the active set of the inequalities: the
most probable function that satisfies all inequalities has equality there. The active set is found greedily, and may
contain a few samples too many. It is discarded if it makes the misfit much worse: the squared amounts by which the
process falls short of limits, plus the squared leave-one-out errors of the other samples. With inducing points, a
process keeps its hyperparameters, and residuals replace leave-one-out errors. References: S. Da Veiga, A. Marrel
(2012), Annales de la Faculte des Sciences de Toulouse 21(3); H. Maatouk, X. Bay (2017), Mathematical Geosciences 49(5).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from surrogym_server.environment.features import FeatureMap
from surrogym_server.gp import Joint, Posterior, condition_sparse
from surrogym_server.models.gaussian_process.learning.output_learner import OutputLearner
from surrogym_server.models.gaussian_process.learning.rates import inputs_of, output_with_rates
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel

# Warm starts are stored by output. For a fit that includes samples at limits (bounds) of other coordinates, this is
# added to the output's name.
WIDER = " past limits"
# Warm starts are stored by output. For a fit that includes samples at the limits (bounds) of the output's own
# coordinate, this is added to the output's name.
HELD = " held"
# If a sample ended at a bound, the prediction may fall short of it by this many standard deviations of the targets.
SHORT = 0.01
ROUNDS = 3  # a process is fitted again at most this often, each time with further samples that ended at a bound
# Samples that ended at a bound are discarded if they increase the misfit by more than this factor. The factor is large
# because few samples measure the misfit only roughly.
WORSE = 10.0
MOST = 200  # at most this many samples that ended at a bound are added to a fit, as observations of the bound


def past_limits(
    learner: OutputLearner,
    output: OutputModel,
    target: Tensor,
    inputs: Mapping[FeatureMap, Tensor],
    keep: Tensor,
    keep_lead: Tensor,
    more: Tensor,
    side: Tensor,
) -> OutputModel:
    """Learn the output also from samples that ended at limits of other coordinates. Return the result if its error is
    smaller, otherwise ``output``.

    Args:
        learner: fitter of the model's outputs.
        output: the output, learned from the samples ``keep``, or from ``keep_lead`` if it reads a lead (the next value
            of another coordinate).
        target: targets (n,) of all samples.
        inputs: features (n, d) of the samples for each candidate feature map (encoding of state and action).
        keep, keep_lead: (n,) bool, see ``output``.
        more: (n,) bool, samples that may be used if limits of other coordinates don't affect the output.
        side: (n,) 1 for a sample that ended at the output's own upper limit, -1 at the lower, otherwise 0.
    """
    rows = keep_lead if output.feature_map.lead else keep
    if not bool((more & ~keep).any()):
        return output
    plain = {m: x for m, x in inputs.items() if not m.lead}
    wide, every = keep | more, rows | more
    wider = output_with_rates(learner, output.name + WIDER, target, plain, wide, wide, side)
    if wider.posterior is None:
        return output
    wider = replace(wider, name=output.name, past_limits=True)
    if output.posterior is None:
        return wider
    error = _error(wider, target, inputs_of(wider, inputs), wide, every)
    return wider if error < _error(output, target, inputs_of(output, inputs), rows, every) else output


def within_limits(
    learner: OutputLearner,
    output: OutputModel,
    target: Tensor,
    inputs: Mapping[FeatureMap, Tensor],
    keep: Tensor,
    side: Tensor,
) -> OutputModel:
    """Return the output, learned also from samples at its own limit that it contradicts. At such a sample, without the
    limit the step would have gone at least as far. If the output predicts less, the sample is added as an observation
    of the limit.

    Args:
        learner: fitter of the model's outputs.
        output: the output, learned from the samples ``keep``.
        target: targets (n,) of all samples.
        inputs: features (n, d) of the samples for each candidate feature map (encoding of state and action).
        keep: (n,) bool, the samples from which ``output`` was learned.
        side: (n,) 1 for a sample that ended at the output's own upper limit, -1 at the lower, otherwise 0.
    """
    if output.feature_map.lead:
        return output
    name, past, plain = output.name, output.past_limits, {m: x for m, x in inputs.items() if not m.lead}
    for _ in range(ROUNDS):
        rows = ((side != 0) & ~keep).nonzero()[:, 0]
        if output.posterior is None or not len(rows):
            break
        x = inputs_of(output, inputs)[rows]
        y = output.standardised(target[rows], x)
        violated = rows[_violated(output.posterior, x, y, side[rows] * output.amplitude(x))]
        if not len(violated):
            break
        more = keep.index_fill(0, violated, value=True)
        if output.posterior.sparse is None:
            again = output_with_rates(learner, name + HELD, target, plain, more, more, side)
        else:
            again = with_samples(learner, output, target, inputs, more)
        candidate = replace(again, name=name, past_limits=past, at_limit=_sides(again, side[more]))
        if _misfit(candidate, target, inputs, more, side) > WORSE * _misfit(output, target, inputs, keep, side):
            break
        output, keep = candidate, more
    return output


def _sides(output: OutputModel, side: Tensor) -> tuple[int, ...]:
    """Return ``side`` (n,), the sign of the limit at which each sample ended or 0, as integers if the process is exact.
    Otherwise return (), because inducing points are not samples."""
    exact = output.posterior is not None and output.posterior.sparse is None
    return tuple(side.int().tolist()) if exact else ()


def _misfit(
    output: OutputModel, target: Tensor, inputs: Mapping[FeatureMap, Tensor], rows: Tensor, side: Tensor
) -> float:
    """Return the misfit of an output: a sum of squared errors of its targets (n,).

    ``side`` (n,) is not 0 at samples that ended at the output's own limit. Their error is the amount by which the
    prediction falls short of the limit. Of the other samples, only those in ``rows`` (n,), from which the output was
    learned, contribute: with their leave-one-out errors, or with their residuals if there are inducing points.
    """
    if output.posterior is None:
        return float("inf")
    x = inputs_of(output, inputs)
    short = (side * (target - output.mean(x))).clamp_min(0)
    if output.posterior.sparse is None:
        predictions, _ = output.posterior.leave_one_out()
        off = output.scale * output.amplitude(x[rows]) * (predictions - output.posterior.y)
    else:
        off = (target - output.mean(x))[rows]
    return float(short.square().sum() + off[side[rows] == 0].square().sum())


def with_samples(
    learner: OutputLearner, output: OutputModel, target: Tensor, inputs: Mapping[FeatureMap, Tensor], keep: Tensor
) -> OutputModel:
    """Condition the output on the samples ``keep`` (n,) with unchanged hyperparameters.

    With many samples, fitting hyperparameters takes long, and a few more samples hardly change them.
    """
    assert output.posterior is not None
    x = inputs_of(output, inputs)[keep]
    y = output.standardised(target[keep], x)
    posterior = condition_sparse(output.posterior.hyper, x, y, learner.settings.inducing or None)
    return replace(output, posterior=posterior)


def _violated(posterior: Posterior, x: Tensor, y: Tensor, side: Tensor) -> list[int]:
    """Select some of k points that ended at a limit, so that the process predicts at least the limit at all of them if
    it observes the limit at the selected points. Return the indices of these points.

    The selection is greedy: the next point is always the one at which the prediction falls short of the limit by most.

    Args:
        posterior: the process.
        x: inputs (k, d) of the points.
        y: standardised limits (k,).
        side: (k,) 1 for an upper and -1 for a lower limit, multiplied by the amplitude with which the output's rates
            scale the process at the point (1 without rates).
    """
    joint, mean = Joint.of(posterior, x), posterior.mean(x)
    points: list[int] = []
    while len(points) < min(MOST, len(y)):
        short = (side * (y - mean)).index_fill(0, torch.tensor(points, dtype=torch.long), 0.0)
        worst = int(short.argmax())
        if short[worst] <= SHORT:
            break
        joint, spread = joint.observe(worst), (joint.variance[worst] + joint.noise).sqrt()
        mean = mean + joint.observed[-1] * (y - mean)[worst] / spread
        points.append(worst)
    return points


def _error(output: OutputModel, target: Tensor, x: Tensor, rows: Tensor, every: Tensor) -> float:
    """Return the mean squared error of targets (n,) at inputs x (n, d), over the samples ``every`` (n,).

    The samples ``rows`` (n,), from which the output was learned, count with their leave-one-out errors, the others with
    their residuals. If the process has inducing points, all samples count with their residuals, because each of so many
    samples hardly influences the process.
    """
    assert output.posterior is not None
    if output.posterior.sparse is not None:
        return float((target - output.mean(x))[every].square().mean())
    error, others = output.leave_one_out().error ** 2, every & ~rows
    if not bool(others.any()):
        return error
    count, left = int(every.sum()), int(others.sum())
    return ((count - left) * error + float((target[others] - output.mean(x[others])).square().sum())) / count
