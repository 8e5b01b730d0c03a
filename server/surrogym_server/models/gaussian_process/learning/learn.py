"""Learning a model from samples: targets, censoring at bounds, and the choice of feature maps by evidence."""

from __future__ import annotations

import torch

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import encode, leading
from surrogym_server.environment.samples import Samples, increments, limit_sides, saturated
from surrogym_server.errors import InvalidInput
from surrogym_server.models.gaussian_process.censoring import saturates, stopped
from surrogym_server.models.gaussian_process.feature_maps import candidates
from surrogym_server.models.gaussian_process.learning.angle_prediction import learn_drift
from surrogym_server.models.gaussian_process.learning.dropping import without_inputs
from surrogym_server.models.gaussian_process.learning.limits import held, past_limits
from surrogym_server.models.gaussian_process.learning.many import ByBound, BySubsets
from surrogym_server.models.gaussian_process.learning.output_learner import OutputLearner
from surrogym_server.models.gaussian_process.learning.rates import output_with_rates
from surrogym_server.models.gaussian_process.learning.region import learn_termination
from surrogym_server.models.gaussian_process.learning.repeats import with_samples_of_others
from surrogym_server.models.gaussian_process.learning.reward import learn_reward
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.models.gaussian_process.settings import Settings
from surrogym_server.models.port import Learned, Warm

MIN_POINTS = 2


def learn(settings: Settings, definition: EnvironmentDefinition, samples: Samples, warm: Warm) -> Learned:
    """Learn as ``Learner.learn`` says.

    Raises:
        InvalidInput: fewer than two samples.
    """
    if len(samples) < MIN_POINTS:
        raise InvalidInput(f"a model needs at least {MIN_POINTS} samples, got {len(samples)}")
    many = ByBound(settings.inducing) if settings.inducing else BySubsets()
    learner = OutputLearner(definition, settings, warm, {}, many)
    transitions = _transitions(learner, samples)
    paying, terminal_reward, jumps = learn_reward(learner, samples)
    ends = learn_termination(learner, samples) if definition.learns_termination else None
    model = GaussianProcessModel(
        definition, transitions, paying, terminal_reward, len(samples), samples.digest, ends, jumps
    )
    return Learned(model, learner.thetas)


def _transitions(learner: OutputLearner, samples: Samples) -> tuple[OutputModel, ...]:
    definition = learner.definition
    everything, change = torch.ones(len(samples), dtype=torch.bool), increments(definition, samples)
    if definition.moves_observation:
        (feature_map,) = candidates(definition, follows=False)
        inputs = {feature_map: encode(definition, feature_map, samples.q, samples.u)}
        return tuple(
            learner.output(name, change[:, i], inputs, everything, everything)
            for i, name in enumerate(definition.observation_names)
        )
    keep = ~saturated(definition, samples.q_next)
    keep = keep if int(keep.sum()) >= MIN_POINTS else everything
    sides = limit_sides(definition, samples.q_next)
    sides = sides * ((sides != 0).sum(-1, keepdim=True) == 1)  # a wall, or another limit, says nothing of this kind
    lead, drift = leading(definition), learn_drift(definition, samples)
    outputs = []
    for column, index in enumerate(definition.moving):
        maps = learner.allowed(candidates(definition, follows=index not in lead, drift=drift))
        inputs = {m: encode(definition, m, samples.q, samples.u, samples.q_next[:, lead]) for m in maps}
        keep_lead = ~saturates(definition, index, samples.q_next) | keep
        name = definition.coordinates[index].name
        target, side = change[:, column], sides[:, index]
        output = output_with_rates(learner, name, target, inputs, keep, keep_lead, side)
        more = ~stopped(definition, index, samples.q_next)
        output = past_limits(learner, output, target, inputs, keep, keep_lead, more, side)
        used = more if output.past_limits else keep
        output = held(learner, output, target, inputs, used, side)
        outputs.append(without_inputs(learner, output, target, inputs, used))
    return with_samples_of_others(learner, outputs)
