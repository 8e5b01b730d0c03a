"""Decide by evidence whether an output changes faster the larger its inputs are; see ``gp.growth``."""

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

ODDS = -3.0  # prior log odds that an input has a rate (the output changes faster the larger the input is)
# Inputs may have rates only if there are at least this many samples per rate. With fewer samples, rates are uncertain
# and predictions overconfident.
FEWEST = 8


def output_with_rates(
    learner: OutputLearner,
    name: str,
    target: Tensor,
    inputs: Mapping[FeatureMap, Tensor],
    keep: Tensor,
    keep_lead: Tensor,
    side: Tensor,
) -> OutputModel:
    """Fit one output as ``OutputLearner.output`` does. Then fit the output with the same inputs and rates, with which
    it changes faster the larger an input is. Return the likelier fit.

    Args:
        learner: fitter of the model's outputs.
        name: name of the output.
        target: targets (n,).
        inputs: features (n, d) of the samples for each candidate feature map (encoding of state and action).
        keep: (n,) bool, the samples to learn from.
        keep_lead: (n,) bool, the samples to learn from if the best map reads a lead (next value of another coordinate).
        side: (n,) 1 for a sample that ended at the output's own upper limit, -1 at the lower, otherwise 0.
    """
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
    """Return the inputs (n, d) of an output's process at n samples.

    A feature map may have rates: numbers (d,) that say how much faster the output changes where an input is large.
    ``inputs`` has the features before rates are applied, by feature map; ``bend`` applies them.
    """
    x, rates = inputs[replace(output.feature_map, rates=())], output.feature_map.rates
    return bend(x, torch.tensor(rates, dtype=x.dtype)) if rates else x


def _may_have_rates(
    learner: OutputLearner, output: OutputModel, inputs: Mapping[FeatureMap, Tensor], keep: Tensor
) -> Tensor:
    """Return for each of the d inputs of an output whether it may have a rate, with which the output changes faster the
    larger the input is, (d,) bool.

    No input may have a rate if there are too few samples to determine rates, or if the process predicts well already.
    ``inputs`` has the features (n, d) of the samples by feature map; ``keep`` (n,) is true for the samples to learn
    from.
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
    """Fit the output with rates of those inputs for which ``may`` (d,) is true, from the samples ``keep`` (n,)."""
    plain = output.feature_map
    z, t = inputs[plain][keep], (target[keep] - output.centre) / output.scale
    rows, among = spread(len(t), subsets.FEW), ",".join(map(str, may.nonzero().ravel().tolist()))
    # The key of a warm start names the inputs that may have a rate, because the warm start has one rate for each.
    key = f"{output.name}|{plain}|rates of {among}"
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
    """Return the log density of the targets of the samples ``keep`` (n,), divided by the output's scale, under each of
    several fits ``outputs`` of one output.

    If a process has inducing points, its evidence of all samples is unknown. Then the sum of the log densities of each
    target given all others is used instead, for all fits.
    """
    pairs = [(output, posterior) for output in outputs if (posterior := output.posterior) is not None]
    exact = all(posterior.sparse is None for _, posterior in pairs)
    return [
        (posterior.log_evidence if exact else posterior.points * posterior.left_out.log_density)
        - float(output.amplitude(inputs_of(output, inputs)[keep]).log().sum())
        for output, posterior in pairs
    ]
