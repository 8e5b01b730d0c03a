"""Learning of a region from labelled states, such as the region in which episodes end."""

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

HANDICAP = 3.0  # log odds against the classifier, whose hyperparameters were fitted to the left-out labels as well
FAINT = 0.05  # a form of the region is discarded if its weight is below this share of the best form's weight


def learn_termination(learner: OutputLearner, samples: Samples, prior: GaussianProcessModel | None = None) -> Region:
    """Learn the region in which episodes end. It is empty while no sample has ended an episode.

    If the samples agree with the region of a prior without exception, that region is returned.
    """
    if prior is not None and prior.ending is not None:
        agrees = (prior.ending.probability(samples.q_next) > 0.5) == samples.terminated
        if bool(agrees.all()):
            return prior.ending
    return learn_region(learner, TERMINATION, samples.q_next, samples.terminated)


def learn_region(learner: OutputLearner, name: str, q: Tensor, inside: Tensor) -> Region:
    """Learn the region of those states q (n, C) for which ``inside`` (n,) is true.

    It combines thresholds and a classifier, weighted by how well each predicts left-out labels.
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
    else:  # of thousands of points each hardly influences its own prediction, so none is left out
        mean, latent = process.posterior.mean_and_variance(inputs[process.feature_map])
        variance = latent + process.posterior.hyper.noise_variance
    probability = likely(process.centre + process.scale * mean, process.scale * variance.sqrt())
    return Classifier(definition, process), log_probability(probability, inside) - HANDICAP
