"""Learning a model from samples: transition outputs one by one, then the reward and the termination."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import FeatureMap, encode, leading
from surrogym_server.environment.samples import Samples, increments, limit_sides, saturated
from surrogym_server.errors import InvalidInput
from surrogym_server.models.gaussian_process.censoring import saturates, stopped
from surrogym_server.models.gaussian_process.feature_maps import candidates
from surrogym_server.models.gaussian_process.learning.angle_prediction import learn_drift
from surrogym_server.models.gaussian_process.learning.dropping import without_inputs
from surrogym_server.models.gaussian_process.learning.limits import past_limits, within_limits
from surrogym_server.models.gaussian_process.learning.output_learner import OutputLearner
from surrogym_server.models.gaussian_process.learning.prior import Known, better_of
from surrogym_server.models.gaussian_process.learning.rates import output_with_rates
from surrogym_server.models.gaussian_process.learning.region import learn_termination
from surrogym_server.models.gaussian_process.learning.repeats import with_samples_of_others
from surrogym_server.models.gaussian_process.learning.reward import learn_reward
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.models.gaussian_process.settings import Settings
from surrogym_server.models.port import Learned, Warm

MIN_POINTS = 2  # a model can't be learned from fewer samples than this


def learn(
    settings: Settings,
    definition: EnvironmentDefinition,
    samples: Samples,
    warm: Warm,
    prior: GaussianProcessModel | None = None,
) -> Learned:
    """Learn a model from samples; see ``Learner.learn``. ``prior`` is another model of the same environment, for
    example of a simulator, to whose predictions outputs may be added; or None.

    Raises:
        InvalidInput: there are fewer than two samples.
        NumericalFailure: no jitter makes the covariance of the points positive definite.
    """
    if len(samples) < MIN_POINTS:
        raise InvalidInput(
            f"a model needs at least {MIN_POINTS} samples, got {len(samples)}; add samples before you learn"
        )
    learner = OutputLearner(definition, settings, warm, {})
    known = None if prior is None else Known.of(prior, samples)
    transitions = _transitions(learner, samples, None if known is None else known.change)
    paying, terminal_reward, jumps = learn_reward(learner, samples, known)
    ends = learn_termination(learner, samples, prior) if definition.learns_termination else None
    model = GaussianProcessModel(
        definition, transitions, paying, terminal_reward, len(samples), samples.digest, ends, jumps, prior
    )
    return Learned(model, learner.thetas)


@dataclass(frozen=True)
class _Among:
    """Candidate inputs of one transition output, and masks (n,) of the samples from which it may learn.

    Attributes:
        inputs: features (n, d) of the samples for each candidate feature map (encoding of state and action).
        keep: samples that did not end at a bound, which would cut their increments off.
        keep_lead: samples to learn from if next values of other coordinates (leads) are inputs.
        past: samples to learn from if this output does not change when other coordinates reach their limits.
        side: (n,) 1 for a sample that ended at the output's own upper limit, -1 at the lower, otherwise 0.
    """

    inputs: dict[FeatureMap, Tensor]
    keep: Tensor
    keep_lead: Tensor
    past: Tensor
    side: Tensor


def _transitions(learner: OutputLearner, samples: Samples, known: Tensor | None) -> tuple[OutputModel, ...]:
    """Learn all M transition outputs. ``known`` (n, M) is the prediction of the prior model at the samples, or None
    without a prior."""
    definition = learner.definition
    everything, change = torch.ones(len(samples), dtype=torch.bool), increments(definition, samples)
    columns = [None] * change.shape[1] if known is None else list(known.T)
    if definition.moves_observation:
        (feature_map,) = candidates(definition, follows=False)
        inputs = {feature_map: encode(definition, feature_map, samples.q, samples.u)}

        def of_observation(name: str, target: Tensor) -> OutputModel:
            return learner.output(name, target, inputs, everything, everything)

        names = definition.observation_names
        return tuple(
            better_of(of_observation, name, change[:, i], columns[i], everything) for i, name in enumerate(names)
        )
    keep = ~saturated(definition, samples.q_next)
    keep = keep if int(keep.sum()) >= MIN_POINTS else everything
    sides = limit_sides(definition, samples.q_next)
    # ``sides`` marks samples that ended at a bound of a coordinate, which give an inequality for this coordinate. A
    # sample at bounds of several coordinates gives none, so it is not marked.
    sides = sides * ((sides != 0).sum(-1, keepdim=True) == 1)
    lead, drift = leading(definition), learn_drift(definition, samples)
    outputs = []
    for column, index in enumerate(definition.moving):
        maps = learner.allowed(candidates(definition, follows=index not in lead, drift=drift))
        inputs = {m: encode(definition, m, samples.q, samples.u, samples.q_next[:, lead]) for m in maps}
        keep_lead = ~saturates(definition, index, samples.q_next) | keep
        past = ~stopped(definition, index, samples.q_next)
        learn_coordinate = partial(_coordinate, learner, _Among(inputs, keep, keep_lead, past, sides[:, index]))
        name = definition.coordinates[index].name
        outputs.append(better_of(learn_coordinate, name, change[:, column], columns[column], keep))
    return with_samples_of_others(learner, outputs)


def _coordinate(learner: OutputLearner, among: _Among, name: str, target: Tensor) -> OutputModel:
    """Learn the change of the coordinate ``name`` from its values ``target`` (n,) in n samples."""
    inputs, keep, side = among.inputs, among.keep, among.side
    output = output_with_rates(learner, name, target, inputs, keep, among.keep_lead, side)
    output = past_limits(learner, output, target, inputs, keep, among.keep_lead, among.past, side)
    used = among.past if output.past_limits else keep
    output = within_limits(learner, output, target, inputs, used, side)
    return without_inputs(learner, output, target, inputs, used)
