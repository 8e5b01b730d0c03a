"""Decide by evidence which inputs an output's process ignores; see ``gp.selection`` and ``gp.variational_bound``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from surrogym_server.environment.features import FeatureMap, features
from surrogym_server.errors import NumericalFailure
from surrogym_server.gp import (
    Posterior,
    Selection,
    condition,
    fewer_inputs,
    is_noisy,
    loses_nothing,
    select_inputs,
    spread,
    subsets,
)
from surrogym_server.models.gaussian_process.learning.output_learner import OutputLearner, is_unexplained
from surrogym_server.models.gaussian_process.learning.rates import inputs_of
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel

ODDS = -1.0  # prior log odds of leaving out an input
# Inputs are left out only if the log evidence increases by at least this much per sample. With a smaller value, some
# predictions were overconfident.
WIN = 2.0
# Inputs are left out only if the leave-one-out error without them is at most this multiple of the error with them.
LESS = 0.5
# No inputs are left out if there are fewer samples than this. In experiments with fewer, inputs that matter were left
# out.
FEWEST = 20


def without_inputs(
    learner: OutputLearner, output: OutputModel, target: Tensor, inputs: Mapping[FeatureMap, Tensor], used: Tensor
) -> OutputModel:
    """Return the output, learned without those inputs that hardly influence it. If all inputs matter, return ``output``
    itself.

    Args:
        learner: fitter of the model's outputs.
        output: the learned output.
        target: targets of the output, (n,).
        inputs: features (n, d) of the samples for each candidate feature map (encoding of state and action).
        used: (n,) bool, the samples from which the output was learned.
    """
    may, posterior = _may_be_dropped(learner, output), output.posterior
    if posterior is None or not bool(may.any()):
        return output
    x, y = posterior.x, posterior.y
    if posterior.sparse is not None:
        x = inputs_of(output, inputs)[used]
        y = output.standardised(target[used], x)
        # the process also learned from samples at bounds, which ``used`` lacks, so no input can be tested
        if posterior.points != len(x):
            return output
    try:
        if posterior.sparse is not None and (is_noisy(posterior.hyper) or not loses_nothing(posterior)):
            return _of_many(learner, output, posterior, may, x, y)
        rows = spread(len(y), subsets.FEW)
        some = condition(posterior.hyper, x[rows], y[rows])
        selection = select_inputs(some, learner.options(output.name), may, ODDS)
        learner.selections[output.name] = selection
        wins = selection.gain > WIN * len(rows)
        return _with_fewer(learner, output, x, y, selection) if wins else output
    except NumericalFailure:
        return output


def _of_many(
    learner: OutputLearner, output: OutputModel, posterior: Posterior, may: Tensor, x: Tensor, y: Tensor
) -> OutputModel:
    """Leave out inputs of an output whose process has inducing points and was fitted to points x (n, d), y (n,).
    ``may`` (d,) is true for the inputs that may be left out. Without the setting ``inducing``, none are left out if the
    inducing points lose accuracy."""
    inducing = learner.settings.inducing
    if not inducing and not loses_nothing(posterior):
        return output
    selection = fewer_inputs(x, y, posterior, learner.options(output.name), inducing or subsets.SOME, may, ODDS)
    if selection is None:
        return output
    return replace(output, feature_map=map_without(output.feature_map, selection.mask), posterior=selection.posterior)


def _may_be_dropped(learner: OutputLearner, output: OutputModel) -> Tensor:
    """Return for each of the d inputs of an output whether it may be left out, (d,) bool.

    Two kinds of inputs may not be left out: the next value of a leading coordinate, such as a limited speed, because
    only samples that end at its limit show its effect; and inputs along which the output changes faster and faster
    (rates). No input may be left out if there are too few samples, or if the process predicts well already.
    """
    read = features(learner.definition, output.feature_map)
    may = torch.tensor([feature.function not in ("lead", "grown") for feature in read])
    posterior = output.posterior
    none = torch.zeros_like(may)
    if posterior is None or not learner.settings.drop_inputs:
        return none
    enough = posterior.sparse is not None or is_unexplained(posterior)
    return may if posterior.points >= FEWEST and enough else none


def _with_fewer(learner: OutputLearner, output: OutputModel, x: Tensor, y: Tensor, selection: Selection) -> OutputModel:
    """Return the output with only the selected inputs, fitted to points x (n, d), y (n,), if its leave-one-out error is
    then at most ``LESS`` (0.5) times that of ``output``. Otherwise return ``output`` itself."""
    assert output.posterior is not None
    mask, x = selection.mask, x[:, selection.mask]
    feature_map = map_without(output.feature_map, mask)
    if len(y) <= subsets.FEW:
        fewer = condition(selection.hyper, x, y)
    else:
        fewer = learner.refined(output.name, feature_map, x, y, selection.theta)
    if fewer.left_out.error > LESS * output.posterior.left_out.error:
        return output
    scores = (*output.scores, (str(feature_map), selection.score))
    return replace(output, feature_map=feature_map, posterior=fewer, scores=scores)


def map_without(feature_map: FeatureMap, mask: Tensor) -> FeatureMap:
    """Return the feature map with only the features for which ``mask`` (d,) is true."""
    rates = tuple(rate for rate, left in zip(feature_map.rates, mask.tolist(), strict=False) if left)
    return replace(feature_map, dropped=tuple((~mask).nonzero()[:, 0].tolist()), rates=rates)
