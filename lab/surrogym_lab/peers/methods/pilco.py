"""PILCO: policy search by gradients of an expected cost that is predicted with moment matching.

M. P. Deisenroth, C. E. Rasmussen, "PILCO: A Model-Based and Data-Efficient Approach to Policy Search", ICML 2011.

Shapes: K beliefs, C coordinates, G angles, A features, F controls, B basis functions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from surrogym_lab.peers.methods.belief import Imagination, expected_cost
from surrogym_lab.peers.methods.gaussian_process import Processes, conditioned, fit, lowest
from surrogym_lab.peers.methods.states import Control, Held, States, Transitions, episode, random_control
from surrogym_lab.peers.methods.told import told
from surrogym_lab.peers.port import NotApplicable, Real
from surrogym_sampler.original.protocol import Array
from surrogym_shared.spec import EnvironmentSpec, Fixed, Normal, Uniform
from surrogym_trainer.policies.predict import Acting

HALF_TURN = np.pi
SIGNAL_TO_NOISE = 1_000.0  # limit of the processes' hyperparameters, as in the authors' penalty


@dataclass(frozen=True)
class Settings:
    """Settings of PILCO. 50 basis functions are those of the paper's cart-pole (305 parameters)."""

    basis: int = 50
    iterations: int = 150  # of L-BFGS after each episode; the authors' line searches
    horizon: int = 100  # the longest
    spread: float = 1.0  # of the first centres around the starts; 0, the authors', found a local optimum more often
    modes: int = 4  # normal distributions that cover starts anywhere on a circle; the paper has one start


class Pilco:
    """PILCO. The first episode acts at random, every other by the policy so far."""

    def __init__(self, settings: Settings | None = None) -> None:
        self._settings = settings or Settings()

    def learn(self, real: Real, seed: int) -> Iterator[Acting]:
        """Yield the policy after each episode and its optimisation (algorithm 1 of the paper)."""
        states, rng, known = States(real.spec), np.random.default_rng(seed), told(real.spec)
        if known.cost is None:
            raise NotApplicable("PILCO has to know a cost of a tip's distance from a goal")
        torch.manual_seed(seed)
        horizon = min(known.horizon, self._settings.horizon)
        beliefs = start_beliefs(real.spec, self._settings.modes)
        theta = _first_parameters(states, beliefs, self._settings, rng)
        control, data = random_control(states, rng), list[Transitions]()
        while True:
            data.append(episode(real, states, control, horizon, known.repeat))
            model = _model(states, Transitions.joined(data), rng, real.clock.check)
            objective = partial(expected_cost, Imagination(states, model), known.cost, beliefs, horizon)
            theta = _improved(objective, theta, states, self._settings, real.clock.check)
            control = _acting(states, _policy(states, theta))
            yield Held(states, control, known.repeat)


def start_beliefs(spec: EnvironmentSpec, modes: int) -> tuple[Tensor, Tensor]:
    """Means (K, C) and covariances (K, C, C) of the starts. A coordinate that starts anywhere on a circle has as many
    normal distributions as ``modes``, the others have one."""
    parts = [_modes(spec.start[name], modes) for name in spec.coordinate_names]
    grid = np.stack(np.meshgrid(*(means for means, _ in parts), indexing="ij"), -1).reshape(-1, len(parts))
    variances = np.array([max(deviation, 1e-3) ** 2 for _, deviation in parts])
    return torch.from_numpy(grid), torch.from_numpy(np.tile(np.diag(variances), (len(grid), 1, 1)))


def _modes(start: Uniform | Normal | Fixed, modes: int) -> tuple[Array, float]:
    """Means and the common deviation of normal distributions for one coordinate."""
    match start:
        case Fixed(value=value):
            return np.array([value]), 0.0
        case Normal(mean=mean, std=std):
            return np.array([mean]), std
        case Uniform(low=low, high=high):
            count = modes if high - low > HALF_TURN else 1
            width = (high - low) / count
            return np.array([low + width * (place + 0.5) for place in range(count)]), float(width / np.sqrt(12))


def _first_parameters(
    states: States, starts: tuple[Tensor, Tensor], settings: Settings, rng: np.random.Generator
) -> Array:
    """Centres around the starts (means (K, C), covariances (K, C, C)), small random targets, and length scales of one,
    or 0.7 for features of angles."""
    basis = settings.basis
    means, covariances = (part.numpy() for part in starts)
    drawn = rng.integers(len(means), size=basis)
    spread = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))  # the covariances are diagonal
    at = states.featured(means[drawn] + spread[drawn] * rng.standard_normal((basis, means.shape[1])))
    centres = at + settings.spread * rng.standard_normal(at.shape)
    targets = 0.1 * rng.standard_normal((basis, states.controls))
    linear = int((~states.angles).sum())
    scales = np.where(np.arange(states.features) < linear, 1.0, 0.7)
    return np.concatenate([centres.ravel(), targets.ravel(), np.log(scales)])


def _policy(states: States, theta: Tensor | Array) -> Processes:
    """The policy before it is squashed: means of processes with B pseudo-samples (section 2.3 of the paper)."""
    theta = torch.as_tensor(theta)
    size, controls = states.features, states.controls
    basis = (len(theta) - size) // (size + controls)
    centres = theta[: basis * size].reshape(basis, size)
    targets = theta[basis * size : -size].reshape(basis, controls)
    lengthscale = theta[-size:].exp().expand(controls, size)
    one = torch.ones(controls, dtype=theta.dtype)
    return conditioned(centres, targets, lengthscale, one, 0.01 * one)


def _model(states: States, data: Transitions, rng: np.random.Generator, check: Callable[[], None]) -> Processes:
    """Processes from features and controls to changes of coordinates."""
    inputs = np.concatenate([states.featured(data.q), data.u], 1)
    return fit(inputs, states.change(data.q, data.reached), SIGNAL_TO_NOISE, rng, check)


def _improved(
    objective: Callable[[Processes], Tensor],
    theta: Array,
    states: States,
    settings: Settings,
    check: Callable[[], None],
) -> Array:
    """Parameters of the policy after a search by L-BFGS from ``theta``."""

    def value_and_slope(values: Array) -> tuple[float, Array]:
        check()
        parameters = torch.from_numpy(values).requires_grad_()
        try:
            cost = objective(_policy(states, parameters))
        except RuntimeError:  # the policy has no Cholesky factor
            return np.nan, np.zeros_like(values)
        cost.backward()  # type: ignore[no-untyped-call]
        assert parameters.grad is not None
        return cost.item(), parameters.grad.numpy()

    # The cost is flat until the tip comes near its goal. The authors' search has no tolerances, at which it would end.
    return lowest(value_and_slope, theta, maxiter=settings.iterations, maxfun=2 * settings.iterations, ftol=0, gtol=0)


def _acting(states: States, policy: Processes) -> Control:
    """The policy as a function of coordinates."""

    def control(q: Array) -> Array:
        wanted = policy.predict(torch.from_numpy(states.featured(q)))[0].numpy()
        chosen: Array = 9 / 8 * np.sin(wanted) + np.sin(3 * wanted) / 8
        return chosen

    return control
