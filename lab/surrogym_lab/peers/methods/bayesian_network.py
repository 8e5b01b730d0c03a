"""A Bayesian network in PILCO's loop: policy search by gradients through particles, which are redrawn at each step.

Y. Gal, R. McAllister, C. E. Rasmussen, "Improving PILCO with Bayesian Neural Network Dynamics Models", Data-Efficient
Machine Learning workshop at ICML 2016. Settings that the paper does not fix are those of a later implementation
(mcgillmrl/prob_mbrl).

Shapes: K beliefs about the start, N particles of each, C coordinates, A features, F controls, B basis functions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from surrogym_lab.peers.methods.dropout_network import DropoutNetwork, train
from surrogym_lab.peers.methods.pilco import start_beliefs
from surrogym_lab.peers.methods.states import Held, States, Transitions, episode, random_control
from surrogym_lab.peers.methods.told import TipCost, told
from surrogym_lab.peers.port import NotApplicable, Real
from surrogym_sampler.original.protocol import Array
from surrogym_trainer.policies.predict import Acting

JITTER = 1e-9  # of a covariance of particles


@dataclass(frozen=True)
class Settings:
    """Settings of the network, the particles and the search."""

    hidden: int = 200
    rate: float = 0.05  # of dropout
    decay: float = 1e-4
    learning: float = 1e-3
    training: int = 2_000  # steps after each episode
    batch: int = 100
    particles: int = 100  # of each belief about the start
    modes: int = 4  # beliefs that cover starts anywhere on a circle, as in PILCO
    basis: int = 50
    search: int = 500  # steps after each episode
    policy_learning: float = 1e-2
    clip: float = 1.0  # norm of a gradient
    horizon: int = 60  # the longest


class BayesianNetwork:
    """Deep PILCO. The first episode acts at random, every other by the policy so far. It knows what PILCO knows."""

    def __init__(self, settings: Settings | None = None) -> None:
        self._settings = settings or Settings()

    def learn(self, real: Real, seed: int) -> Iterator[Acting]:
        """Yield the policy after each episode and its optimisation (algorithm 1 of the paper)."""
        chosen, states, known = self._settings, States(real.spec), told(real.spec)
        if known.cost is None:
            raise NotApplicable("a Bayesian network in PILCO's loop has to know a cost of a tip's distance from a goal")
        rng, size = np.random.default_rng(seed), len(states.angles)
        torch.manual_seed(seed)
        horizon = min(known.horizon, chosen.horizon)
        model = DropoutNetwork(states.features + states.controls, size, chosen.hidden, chosen.rate)
        optimizer = torch.optim.Adam(model.parameters(), chosen.learning, weight_decay=chosen.decay)
        beliefs = start_beliefs(real.spec, chosen.modes)
        policy = Policy(states, beliefs[0], chosen.basis, rng)
        imagined = Particles(states, model, known.cost, beliefs, chosen.particles)
        control, data = random_control(states, rng), list[Transitions]()
        while True:
            data.append(episode(real, states, control, horizon, known.repeat))
            seen = Transitions.joined(data)
            inputs = np.concatenate([states.featured(seen.q), seen.u], 1)
            x, y = map(torch.from_numpy, (inputs, states.change(seen.q, seen.reached)))
            train(model, optimizer, x, y, chosen.training, chosen.batch, real.clock.check)
            search(policy, lambda: imagined.cost(policy, horizon), chosen, real.clock.check)
            control = policy.control
            yield Held(states, deepcopy(policy).control, known.repeat)


class Policy(nn.Module):
    """Sums of Gaussian basis functions of the features, squashed to [-1, 1] as PILCO does it.

    Args:
        states: how the coordinates are seen.
        starts: coordinates (K, C), near whose features the basis functions begin.
        basis: their number B.
        rng: random generator.
    """

    def __init__(self, states: States, starts: Tensor, basis: int, rng: np.random.Generator) -> None:
        super().__init__()
        self._states = states
        featured = states.featured(starts.numpy())
        near = featured[rng.integers(len(featured), size=basis)] + rng.standard_normal((basis, states.features))
        self.centres = nn.Parameter(torch.from_numpy(near))
        self.weights = nn.Parameter(torch.from_numpy(0.1 * rng.standard_normal((basis, states.controls))))
        self.log_scales = nn.Parameter(torch.zeros(states.features).double())

    def forward(self, features: Tensor) -> Tensor:
        """Controls (n, F) at features (n, A)."""
        scaled = (features[:, None] - self.centres) / self.log_scales.exp()
        wanted = torch.exp(-(scaled**2).sum(-1) / 2) @ self.weights
        return 9 / 8 * torch.sin(wanted) + torch.sin(3 * wanted) / 8

    @torch.no_grad()
    def control(self, q: Array) -> Array:
        """Controls (n, F) at coordinates (n, C)."""
        chosen: Array = self(torch.from_numpy(self._states.featured(q))).numpy()
        return chosen


class Particles:
    """Episodes of a policy through the network.

    Args:
        states: how the coordinates are seen.
        model: from features and controls to changes of coordinates.
        cost: of a state.
        beliefs: means (K, C) and covariances (K, C, C) of the starts.
        count: N.
    """

    def __init__(
        self, states: States, model: DropoutNetwork, cost: TipCost, beliefs: tuple[Tensor, Tensor], count: int
    ) -> None:
        self._states = states
        self._model = model
        self._cost = cost
        self._beliefs = beliefs
        self._count = count

    def cost(self, policy: Policy, horizon: int) -> Tensor:
        """Mean cost of an episode, with gradients by the policy.

        Each particle keeps its draw of the network's weights. After each step, the particles of a belief are replaced
        by draws from the normal distribution with their mean and covariance (section 3 of the paper).
        """
        mean, covariance = self._beliefs
        noise = torch.randn(horizon + 1, len(mean), self._count, mean.shape[1], dtype=mean.dtype)
        q = mean[:, None] + noise[0] @ torch.linalg.cholesky(covariance).mT
        masks, total = self._model.masks(len(mean) * self._count), torch.zeros((), dtype=mean.dtype)
        for drawn in noise[1:]:
            flat = q.flatten(0, 1)
            features = self._featured(flat)
            change = self._model(torch.cat([features, policy(features)], 1), masks)
            q = matched((flat + change).reshape(q.shape), drawn)
            total = total + tip_costs(self._cost, q).mean()
        return total

    def _featured(self, q: Tensor) -> Tensor:
        angles = torch.from_numpy(self._states.angles)
        return torch.cat([q[:, ~angles], torch.cos(q[:, angles]), torch.sin(q[:, angles])], 1)


def matched(q: Tensor, noise: Tensor) -> Tensor:
    """Particles (K, N, C) from the normal distributions with the mean and covariance of others (K, N, C), at standard
    normal numbers (K, N, C)."""
    mean = q.mean(1, keepdim=True)
    apart = q - mean
    covariance = apart.mT @ apart / (q.shape[1] - 1) + JITTER * torch.eye(q.shape[2], dtype=q.dtype)
    drawn: Tensor = mean + noise @ torch.linalg.cholesky(covariance).mT
    return drawn


def tip_costs(cost: TipCost, q: Tensor) -> Tensor:
    """Costs (...) of states (..., C)."""
    angles, linear, sines, cosines, goal = map(
        torch.from_numpy, (cost.angles, cost.linear, cost.sines, cost.cosines, cost.goal.astype(np.float64))
    )
    turned = q @ angles.T
    tip = q @ linear.T + torch.sin(turned) @ sines.T + torch.cos(turned) @ cosines.T
    return 1 - torch.exp(-((tip - goal) ** 2).sum(-1) / (2 * cost.width**2))


def search(policy: Policy, cost: Callable[[], Tensor], settings: Settings, check: Callable[[], None]) -> None:
    """Lower a cost that is drawn anew at each step, by Adam. A draw without a value is left out."""
    optimizer = torch.optim.Adam(policy.parameters(), settings.policy_learning)
    for _ in range(settings.search):
        check()
        optimizer.zero_grad()
        try:
            cost().backward()  # type: ignore[no-untyped-call]
        except RuntimeError:  # the particles' covariance has no Cholesky factor
            continue
        size = nn.utils.clip_grad_norm_(policy.parameters(), settings.clip)
        if torch.isfinite(size):
            optimizer.step()
