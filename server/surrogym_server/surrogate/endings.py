"""Learning where episodes end, from samples that say whether they did."""

from __future__ import annotations

import math

import torch

from surrogym_server.surrogate.features import candidates, encode
from surrogym_server.surrogate.learner import Learner
from surrogym_server.surrogate.regions import Classifier, Form, Region, likely
from surrogym_server.surrogate.samples import Samples
from surrogym_server.surrogate.thresholds import log_probability, thresholds

TERMINATION = "termination"
HANDICAP = 3.0  # log odds against the classifier, whose hyperparameters have seen the labels that are left out
FAINT = 0.05  # a form of less weight beside the best one's is dropped


def ending(learner: Learner, samples: Samples) -> Region:
    """Where episodes end: thresholds and a classifier, weighed by how well they foretell left-out labels.

    As long as no sample ended, nothing does.
    """
    found: list[tuple[Form, float]] = [_classifier(learner, samples)]
    found += thresholds(learner.definition, samples.q_next, samples.terminated)
    names = [str(form.description.get("inside", "classifier")) for form, _ in found]
    scores = torch.tensor([score for _, score in found], dtype=torch.float64)
    weights = torch.where(scores - scores.max() > math.log(FAINT), scores, -torch.inf).softmax(0).tolist()
    forms = tuple((w, form) for w, (form, _) in zip(weights, found, strict=True) if w > 0)
    return Region(forms, tuple(zip(names, scores.tolist(), strict=True)))


def _classifier(learner: Learner, samples: Samples) -> tuple[Classifier, float]:
    definition = learner.definition
    everything = torch.ones_like(samples.terminated)
    label = 2 * samples.terminated.double() - 1
    maps = [m for m in candidates(definition, follows=False) if m.action == "value"]
    inputs = {m: encode(definition, m, samples.q_next, torch.zeros_like(samples.u)) for m in maps}
    process = learner.output(TERMINATION, label, inputs, everything, everything)
    if process.posterior is None:
        return Classifier(definition, process), 0.0
    mean, variance = process.posterior.leave_one_out()
    probability = likely(process.centre + process.scale * mean, process.scale * variance.sqrt())
    return Classifier(definition, process), log_probability(probability, samples.terminated) - HANDICAP
