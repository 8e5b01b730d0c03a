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
    if output.posterior is None or _error(wider, int(every.sum())) < _error(
        output, int(every.sum()), target[also] - output.mean(inputs[output.feature_map][also])
    ):
        return wider
    return output


def _error(output: OutputModel, count: int, others: Tensor | None = None) -> float:
    """Mean squared error over ``count`` samples: the leave-one-out errors of the samples that an output was learned
    from, and the errors (m,) at ``others``."""
    found = output.leave_one_out().error ** 2
    if others is None:
        return found
    return ((count - len(others)) * found + float(others.square().sum())) / count
