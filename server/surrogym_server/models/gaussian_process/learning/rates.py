"""Choice by evidence whether an output changes the faster the further along its inputs, see ``gp.growth``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from surrogym_server.environment.features import FeatureMap, features
from surrogym_server.errors import NumericalFailure
from surrogym_server.gp import fit_growing, spread, subsets
from surrogym_server.models.gaussian_process.learning.output_learner import OutputLearner, is_unexplained
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.tensors import EDGE, amplitude, bend

ODDS = -3.0  # log odds of each rate before any data
FEWEST = 8  # samples for each rate: fewer leave a rate uncertain, and predictions with it are too sure


def output_with_rates(
    learner: OutputLearner,
    name: str,
    target: Tensor,
    inputs: Mapping[FeatureMap, Tensor],
    keep: Tensor,
    keep_lead: Tensor,
    side: Tensor,
) -> OutputModel:
    """Fit one output as ``OutputLearner.output`` does. Then its best map may get rates."""
    output = learner.output(name, target, inputs, keep, keep_lead, side)
    may = _may_have_rates(learner, output, inputs, keep)
    if not bool(may.any()):
        return output
    try:
        growing = _growing(learner, output, target, inputs, keep, may)
    except NumericalFailure:
        return output
    if not any(growing.feature_map.rates):
        return output
    plain, other = _evidence([output, growing], inputs, keep)
    other += ODDS * int(may.sum())
    scores = (*output.scores, (str(growing.feature_map), other))
    return replace(growing, scores=scores) if other > plain else output


def inputs_of(output: OutputModel, inputs: Mapping[FeatureMap, Tensor]) -> Tensor:
    """Inputs of an output's process, (n, d), from the features of maps without rates."""
    x, rates = inputs[replace(output.feature_map, rates=())], output.feature_map.rates
    return bend(x, torch.tensor(rates, dtype=x.dtype)) if rates else x


def _may_have_rates(
    learner: OutputLearner, output: OutputModel, inputs: Mapping[FeatureMap, Tensor], keep: Tensor
) -> Tensor:
    """Inputs of an output, (d,) bool, that may have a rate.

    No input may have one if there are too few samples to determine it, or if nothing is left to explain.
    """
    plain, posterior = output.feature_map, output.posterior
    kinds = torch.tensor([feature.function == "affine" for feature in features(learner.definition, plain)])
    none = torch.zeros_like(kinds)
    if posterior is None or not learner.settings.rates or plain.lead or plain.parity:
        return none
    may = kinds & (inputs[plain][keep].abs() <= EDGE).all(0)
    enough = int(keep.sum()) >= FEWEST * int(may.sum())
    return may if enough and is_unexplained(posterior) else none


def _growing(
    learner: OutputLearner,
    output: OutputModel,
    target: Tensor,
    inputs: Mapping[FeatureMap, Tensor],
    keep: Tensor,
    may: Tensor,
) -> OutputModel:
    """The output with rates."""
    plain = output.feature_map
    z, t = inputs[plain][keep], (target[keep] - output.centre) / output.scale
    rows, among = spread(len(t), subsets.FEW), ",".join(map(str, may.nonzero().ravel().tolist()))
    key = f"{output.name}|{plain}|rates of {among}"  # a warm start has a rate for each of these inputs
    starts = [learner.thetas[f"{output.name}|{plain}"], *([learner.warm[key]] if key in learner.warm else [])]
    growth = fit_growing(z[rows], t[rows], may, learner.options(output.name), starts)
    learner.thetas[key] = growth.fitted.theta
    feature_map, rates = replace(plain, rates=growth.rates), torch.tensor(growth.rates, dtype=torch.float64)
    posterior = growth.fitted.posterior
    if len(rows) < len(t):
        x = bend(z, rates)
        posterior = learner.refined(
            output.name, feature_map, x, t / amplitude(x, rates), growth.fitted.theta[: -int(may.sum())]
        )
    return replace(output, feature_map=feature_map, posterior=posterior)


def _evidence(outputs: Sequence[OutputModel], inputs: Mapping[FeatureMap, Tensor], keep: Tensor) -> list[float]:
    """Log density of the targets by each of the outputs, in the output's scale: with inducing points, which have no
    evidence of all samples, the density of each target given all others."""
    pairs = [(output, posterior) for output in outputs if (posterior := output.posterior) is not None]
    exact = all(posterior.sparse is None for _, posterior in pairs)
    return [
        (posterior.log_evidence if exact else posterior.points * posterior.left_out.log_density)
        - float(output.amplitude(inputs_of(output, inputs)[keep]).log().sum())
        for output, posterior in pairs
    ]
