"""Learning of a region of states, such as that in which episodes end, from states labelled as inside or outside."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from surrogym_server.environment.features import encode
from surrogym_server.environment.samples import Samples
from surrogym_server.models.gaussian_process.feature_maps import candidates
from surrogym_server.models.gaussian_process.learning.output_learner import OutputLearner
from surrogym_server.models.gaussian_process.learning.thresholds import log_probability, thresholds
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.regions import TERMINATION, Classifier, Form, Region, likely

# This is subtracted from the leave-one-out log probability of the classifier, because its hyperparameters were also
# fitted to the left-out labels.
HANDICAP = 3.0
# A region is a weighted mean of thresholds and a classifier. One of them is discarded if its weight is at most this
# share of the greatest weight.
FAINT = 0.05


def learn_termination(learner: OutputLearner, samples: Samples, prior: GaussianProcessModel | None = None) -> Region:
    """Learn the region of states in which episodes end. It is empty while no sample has ended an episode.

    If a ``prior`` model has learned this region and all samples agree with it, the prior model's region is returned.
    """
    if prior is not None and prior.ending is not None:
        agrees = (prior.ending.probability(samples.q_next) > 0.5) == samples.terminated
        if bool(agrees.all()):
            return prior.ending
    return learn_region(learner, TERMINATION, samples.q_next, samples.terminated)


def learn_region(learner: OutputLearner, name: str, q: Tensor, inside: Tensor) -> Region:
    """Learn the region that contains those of the states q (n, C) for which ``inside`` (n,) is true.

    The region is a weighted mean of thresholds and a classifier. Each has a weight proportional to the probability with
    which it predicts left-out labels.
    """
    scored: list[tuple[Form, float]] = [_classifier(learner, name, q, inside)]
    scored += thresholds(learner.definition, q, inside)
    names = [str(form.description.get("inside", "classifier")) for form, _ in scored]
    scores = torch.tensor([score for _, score in scored], dtype=torch.float64)
    weights = torch.where(scores - scores.max() > math.log(FAINT), scores, -torch.inf).softmax(0).tolist()
    forms = tuple((w, form) for w, (form, _) in zip(weights, scored, strict=True) if w > 0)
    return Region(forms, tuple(zip(names, scores.tolist(), strict=True)))


def _classifier(learner: OutputLearner, name: str, q: Tensor, inside: Tensor) -> tuple[Classifier, float]:
    definition = learner.definition
    everything, u = torch.ones_like(inside), q.new_zeros(len(q), definition.action.size)
    maps = [m for m in candidates(definition, follows=False, parity="") if m.action == "value"]
    inputs = {m: encode(definition, m, q, u) for m in maps}
    process = learner.output(name, 2 * inside.double() - 1, inputs, everything, everything)
    if process.posterior is None:
        return Classifier(definition, process), 0.0
    if process.posterior.sparse is None:
        mean, variance = process.posterior.leave_one_out()
    else:
        # With inducing points there are many points; none needs to be left out, as each has little influence on its
        # prediction.
        mean, latent = process.posterior.mean_and_variance(inputs[process.feature_map])
        variance = latent + process.posterior.hyper.noise_variance
    probability = likely(process.centre + process.scale * mean, process.scale * variance.sqrt())
    return Classifier(definition, process), log_probability(probability, inside) - HANDICAP
