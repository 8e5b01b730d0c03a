"""Choice by evidence whether an output changes the faster the further along its inputs, see ``gp.growth``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from surrogym_server.environment.features import FeatureMap, features
from surrogym_server.gp import amplitude, bend, fit_growing, spread, subsets
from surrogym_server.models.gaussian_process.learning.output_learner import OutputLearner
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel

ODDS = -3.0  # log odds of each rate before any data
EXPLAINED = 0.01  # of the targets' deviation: if each sample is foretold as well by the others, no rates are tried


def output_with_rates(
    learner: OutputLearner,
    name: str,
    target: Tensor,
    inputs: Mapping[FeatureMap, Tensor],
    keep: Tensor,
    keep_lead: Tensor,
) -> OutputModel:
    """Fit one output as ``OutputLearner.output`` does. Then its best map may get rates."""
    output = learner.output(name, target, inputs, keep, keep_lead)
    plain = output.feature_map
    if output.posterior is None or plain.lead or plain.parity or not learner.settings.rates:
        return output
    may = torch.tensor([f.function == "affine" for f in features(learner.definition, plain)])
    if not bool(may.any()) or output.posterior.left_out.error <= EXPLAINED:
        return output
    z, t = inputs[plain][keep], (target[keep] - output.centre) / output.scale
    rows, key = spread(len(t), subsets.FEW), f"{name}|{plain}|rates"
    starts = [learner.thetas[f"{name}|{plain}"], *([learner.warm[key]] if key in learner.warm else [])]
    found = fit_growing(z[rows], t[rows], may, learner.options(name), starts)
    learner.thetas[key] = found.fitted.theta
    score = found.fitted.score * len(t) / len(rows)
    if score + ODDS * int(may.sum()) <= dict(output.scores)[str(plain)] or not any(found.rates):
        return output
    grown, rates = replace(plain, rates=found.rates), torch.tensor(found.rates, dtype=torch.float64)
    posterior = found.fitted.posterior
    if len(rows) < len(t):
        x = bend(z, rates)
        theta = found.fitted.theta[: -int(may.sum())]
        posterior = learner.refined(name, grown, x, t / amplitude(x, rates), theta)
    return replace(output, feature_map=grown, posterior=posterior, scores=(*output.scores, (str(grown), score)))


def inputs_of(output: OutputModel, inputs: Mapping[FeatureMap, Tensor]) -> Tensor:
    """Inputs of an output's process, (n, d), from the features of maps without rates."""
    x, rates = inputs[replace(output.feature_map, rates=())], output.feature_map.rates
    return bend(x, torch.tensor(rates, dtype=x.dtype)) if rates else x
