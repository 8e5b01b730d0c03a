"""Learning of an ensemble of networks from samples: transitions, reward, terminal reward and termination."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples, increments, saturated
from surrogym_server.errors import InvalidInput
from surrogym_server.models.ensemble.inputs import Inputs
from surrogym_server.models.ensemble.model import NetworkEnsembleModel, Noise, Regression
from surrogym_server.models.ensemble.networks import Networks
from surrogym_server.models.ensemble.training import Training, cross_entropy, squared_error, train, train_with_noise

MIN_POINTS = 2  # a model can't be learned from fewer samples than this
CONSTANT = 1e-9  # an output whose standard deviation is below this share of its absolute mean counts as constant
# Added to the seed, so that networks of reward and termination have other initial weights than those of transitions.
REWARD_SEED, END_SEED = 1, 2


def learn(training: Training, definition: EnvironmentDefinition, samples: Samples) -> NetworkEnsembleModel:
    """Learn a model from samples, by networks with the settings ``training``. Raises ``InvalidInput`` for fewer than
    two samples."""
    if len(samples) < MIN_POINTS:
        raise InvalidInput(
            f"a model needs at least {MIN_POINTS} samples, got {len(samples)}; add samples before you learn"
        )
    inputs = Inputs(definition)
    usable = enough(~saturated(definition, samples.q_next))
    x, change = inputs.of_transition(samples.q, samples.u), increments(definition, samples)
    transitions = _with_noise(training, x[usable], change[usable])
    reward, terminal_reward = _reward(_seeded(training, REWARD_SEED), inputs, samples)
    ending = None
    if definition.learns_termination:
        ending = _ending(_seeded(training, END_SEED), inputs.of_end(samples.q_next), samples.terminated)
    return NetworkEnsembleModel(definition, transitions, reward, ending, terminal_reward, len(samples), samples.digest)


def _reward(training: Training, inputs: Inputs, samples: Samples) -> tuple[Regression | None, float]:
    """Fit networks to the rewards of non-terminating steps. Return the networks (None if the reward is declared), and
    the terminal reward: the mean reward that terminating steps give in addition to the networks' prediction."""
    if (declared := inputs.definition.declared_reward) is not None:
        return None, declared.terminal
    goes_on = enough(~samples.terminated)
    x = inputs.of_reward(samples.q, samples.u, samples.q_next)
    reward = _noiseless(training, x[goes_on], samples.reward[goes_on, None])
    if bool(goes_on.all()):
        return reward, 0.0
    beyond = samples.reward - reward(x).mean(0)[:, 0]
    return reward, float(beyond[~goes_on].mean())


def _ending(training: Training, x: Tensor, ended: Tensor) -> Networks | float:
    """Fit networks to inputs x (n, d) that predict which of n steps ``ended`` (n,) an episode. If all samples have the
    same label, return this label, 0 or 1, instead."""
    if bool(ended.all()) or not bool(ended.any()):
        return float(ended[0])
    return train(training, x, ended.double()[:, None], cross_entropy)


def _with_noise(training: Training, x: Tensor, y: Tensor) -> Regression:
    """Fit networks of the mean, and networks of the noise, to inputs x (n, d) and targets y (n, p)."""
    target, centre, scale = standardised(y)
    networks, noisy = train_with_noise(training, x, target)
    noise = Noise(noisy, torch.zeros_like(scale))
    noise = replace(noise, size=noise.std(x).square().mean(0).sqrt())
    return Regression(networks, centre, scale, noise)


def _noiseless(training: Training, x: Tensor, y: Tensor) -> Regression:
    """Fit networks of the mean alone, without noise, to inputs x (n, d) and targets y (n, p). Their linear part also
    reads the squares of the inputs."""
    target, centre, scale = standardised(y)
    return Regression(train(training, x, target, squared_error, quadratic=True), centre, scale)


def standardised(y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return standardised targets (n, p) of the targets y (n, p), the means (p,) of y, and its standard deviations
    (p,), 0 for a target that never varied."""
    centre, scale = y.mean(0), y.std(0, correction=0)
    scale = torch.where(scale > CONSTANT * centre.abs(), scale, 0.0)
    return (y - centre) / torch.where(scale > 0, scale, 1.0), centre, scale


def enough(chosen: Tensor) -> Tensor:
    """Return the mask ``chosen`` (n,). If it selects fewer than two samples, return a mask that selects all."""
    return chosen if int(chosen.sum()) >= MIN_POINTS else torch.ones_like(chosen)


def _seeded(training: Training, beyond: int) -> Training:
    return replace(training, seed=training.seed + beyond)
