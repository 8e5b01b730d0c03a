"""Learning of the reward: a process for non-terminating steps, jumps, and the terminal reward of steps that end one."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from surrogym_server.environment.declared_reward import RewardFunction
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import FeatureMap, encode
from surrogym_server.environment.samples import Samples
from surrogym_server.models.gaussian_process.feature_maps import reward_candidates
from surrogym_server.models.gaussian_process.learning.jumps import with_jumps
from surrogym_server.models.gaussian_process.learning.output_learner import OutputLearner
from surrogym_server.models.gaussian_process.learning.peaks import with_peak
from surrogym_server.models.gaussian_process.learning.prior import Known, beside, contradicts, log_density
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.models.gaussian_process.prediction.regions import Jump, jumped
from surrogym_shared.spec import REWARD

FEW = 2  # if there are fewer non-terminating steps than this, the reward is learned from terminating steps too


def learn_reward(
    learner: OutputLearner, samples: Samples, prior: Known | None = None
) -> tuple[OutputModel, float, tuple[Jump, ...]]:
    """Learn the reward. Return the output for the reward of non-terminating steps, the reward that terminating steps
    give in addition, and the jumps of the reward.

    ``prior`` contains predictions of a prior model, or is None. The output is instead learned as the difference from
    these predictions, unless left-out samples contradict them, or peaks or jumps predict left-out samples better.
    """
    definition = learner.definition
    if (declared := definition.declared_reward) is not None:
        return _declared(declared, samples), declared.terminal, ()
    inputs = {
        m: encode(definition, m, samples.q_next if m.after else samples.q, samples.u)
        for m in learner.allowed(reward_candidates(definition))
    }
    going = ~samples.terminated if int((~samples.terminated).sum()) >= FEW else torch.ones_like(samples.terminated)
    output = learner.output(REWARD, samples.reward, inputs, going, going)
    jumps: tuple[Jump, ...] = ()
    if learner.settings.reward_peaks:
        output = with_peak(learner, samples.reward, inputs | _without_action(definition, samples), going, output)
    if learner.settings.reward_jumps and output.warp is None:
        output, jumps = with_jumps(learner, samples, inputs, going, output)
    by_prior = torch.zeros_like(samples.reward)
    if prior is not None and prior.reward is not None:
        found = beside(partial(_plain, learner, inputs, going), REWARD, samples.reward, prior.reward, going)
        if not _contradicted(found, output, jumps, int(going.sum())):
            output, jumps, by_prior = found, (), prior.reward
    ended = ~going
    if not bool(ended.any()):
        return output, 0.0 if prior is None else prior.terminal, jumps
    state = samples.q_next if output.feature_map.after else samples.q
    bonus = (samples.reward - by_prior - output.mean(inputs[output.feature_map]) - jumped(jumps, state)[0])[ended]
    return output, float(bonus.mean()), jumps


def _contradicted(found: OutputModel, output: OutputModel, jumps: tuple[Jump, ...], count: int) -> bool:
    """Return whether the reward is learned by ``output`` and its jumps from ``count`` samples, rather than beside the
    prior model (``found``). With peaks or jumps, whose densities can't be compared, leave-one-out errors decide."""
    if jumps or output.warp is not None:
        return found.leave_one_out().error > output.leave_one_out().error
    return contradicts(log_density(found), log_density(output), count)


def _plain(
    learner: OutputLearner, inputs: dict[FeatureMap, Tensor], going: Tensor, name: str, target: Tensor
) -> OutputModel:
    return learner.output(name, target, inputs, going, going)


def _without_action(definition: EnvironmentDefinition, samples: Samples) -> dict[FeatureMap, Tensor]:
    """Return features of the samples for feature maps (encodings of state and action) that ignore the action. These are
    candidates because a reward that is 0 except in one place seldom depends on the action."""
    maps = {replace(m, action="none") for m in reward_candidates(definition) if not m.parity}
    return {
        m: encode(definition, m, samples.q_next if m.after else samples.q, samples.u) for m in sorted(maps, key=str)
    }


def _declared(reward: RewardFunction, samples: Samples) -> OutputModel:
    """Return the reward's output for a declared reward. It has no process. Its score is the largest difference between
    declared rewards and rewards of samples."""
    rewards = reward(samples.q_next if reward.after else samples.q, samples.u) + reward.terminal * samples.terminated
    off = float((samples.reward - rewards).abs().max())
    scores = (("declared, largest error over the samples", off),)
    return OutputModel(REWARD, FeatureMap(after=reward.after), None, 0.0, 1.0, 0, scores)
