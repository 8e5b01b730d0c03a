"""Choice by evidence which inputs an output does not read, see ``gp.selection``."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from surrogym_server.environment.features import features
from surrogym_server.errors import NumericalFailure
from surrogym_server.gp import Posterior, Selection, condition, select_inputs, spread, subsets
from surrogym_server.models.gaussian_process.learning.output_learner import OutputLearner, is_unexplained
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel

ODDS = -1.0  # log odds of each input that is left out, before any data
WIN = 2.0  # log odds for each sample by which fewer inputs must win: below, some made predictions too sure
LESS = 0.5  # share of the leave-one-out error with all inputs that may be left
FEWEST = 20  # samples: of fewer, some gave such odds to wrong inputs


def without_inputs(learner: OutputLearner, output: OutputModel) -> OutputModel:
    """The output without the inputs that it does not read, from the same samples."""
    may, posterior = _may_be_dropped(learner, output), output.posterior
    if posterior is None or not bool(may.any()):
        return output
    try:
        rows = spread(len(posterior.y), subsets.FEW)
        some = condition(posterior.hyper, posterior.x[rows], posterior.y[rows])
        found = select_inputs(some, learner.options(output.name), may, ODDS)
        wins = found.gain > WIN * len(rows)
        return _with_fewer(learner, output, posterior, found) if wins else output
    except NumericalFailure:
        return output


def _may_be_dropped(learner: OutputLearner, output: OutputModel) -> Tensor:
    """Inputs of an output, (d,) bool, that may be left out.

    The next value of a limited speed may not: it seems to say nothing new until a sample ends at the limit. Nor may an
    input with a rate. No input may be left out if there are too few samples to tell, or if nothing is left to explain.
    """
    read = features(learner.definition, output.feature_map)
    may = torch.tensor([feature.function not in ("lead", "grown") for feature in read])
    posterior = output.posterior
    none = torch.zeros_like(may)
    if posterior is None or not learner.settings.drop_inputs:
        return none
    return may if len(posterior.y) >= FEWEST and is_unexplained(posterior) else none


def _with_fewer(learner: OutputLearner, output: OutputModel, posterior: Posterior, found: Selection) -> OutputModel:
    """The output with the inputs that were found, if with these all samples are foretold better by the others."""
    kept, x, y = found.kept, posterior.x[:, found.kept], posterior.y
    rates = output.feature_map.rates
    feature_map = replace(
        output.feature_map,
        dropped=tuple((~kept).nonzero()[:, 0].tolist()),
        rates=tuple(rate for rate, left in zip(rates, kept.tolist(), strict=False) if left),
    )
    if len(y) <= subsets.FEW:
        fewer = condition(found.hyper, x, y)
    else:
        fewer = learner.refined(output.name, feature_map, x, y, found.theta)
    if fewer.left_out.error > LESS * posterior.left_out.error:
        return output
    scores = (*output.scores, (str(feature_map), found.score))
    return replace(output, feature_map=feature_map, posterior=fewer, scores=scores)
