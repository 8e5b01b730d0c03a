"""Decision whether an output learns from samples that ended at a limit of another coordinate.

Such a limit may change the rest of the step or not: a wall stops the speed, but a relief valve leaves the concentration
as smooth as before. Without these samples the process extrapolates where the limit is reached. So both are learned, and
the one with the smaller error over all of these samples is used, each predicted from the others.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from torch import Tensor

from surrogym_server.environment.features import FeatureMap
from surrogym_server.models.gaussian_process.learning.output_learner import OutputLearner
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel

WIDER = " past limits"  # suffix of an output's name, for its hyperparameters


def past_limits(
    learner: OutputLearner,
    output: OutputModel,
    target: Tensor,
    inputs: Mapping[FeatureMap, Tensor],
    keep: Tensor,
    more: Tensor,
) -> OutputModel:
    """The output, learned from samples ``keep`` (n,) with targets (n,), or from ``more`` (n,) as well."""
    also = more & ~keep
    if not bool(also.any()) or output.feature_map.lead:
        return output
    plain = {m: x for m, x in inputs.items() if not m.lead}
    every = keep | more
    wider = learner.output(output.name + WIDER, target, plain, every, every)
    if wider.posterior is None:
        return output
    wider = replace(wider, name=output.name, past_limits=True)
    if output.posterior is None:
        return wider
    wide = _error(wider, target, inputs[wider.feature_map], every, every)
    return wider if wide < _error(output, target, inputs[output.feature_map], keep, every) else output


def _error(output: OutputModel, target: Tensor, x: Tensor, learned: Tensor, every: Tensor) -> float:
    """Mean squared error of targets (n,) at inputs x (n, d), over the samples ``every`` (n,).

    Those of them that the output ``learned`` (n,) count by their leave-one-out errors. A process of inducing points has
    none of its samples: each of these points stands for many samples, so to leave one out says nothing about a sample.
    There the residuals count, because each of many samples hardly influences the process.
    """
    assert output.posterior is not None
    if output.posterior.sparse is not None:
        return float((target - output.mean(x))[every].square().mean())
    found, others = output.leave_one_out().error ** 2, every & ~learned
    if not bool(others.any()):
        return found
    count, left = int(every.sum()), int(others.sum())
    return ((count - left) * found + float((target[others] - output.mean(x[others])).square().sum())) / count
