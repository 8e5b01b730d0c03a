"""Policy search by gradients through the model, on the machine of the server.

The paper's Autograd remark: the return of an imagined episode is a differentiable function of the policy's parameters,
by the mean increments and mean rewards of the processes (AUR-D), step after step. Episodes are cut after a horizon,
because gradients through an unstable system grow with its length, and no lane may outweigh the others. Decaying noise
before the last tanh smooths the return: without it Pendulum ended in a local optimum in three of four runs. A step that
ends an episode ends the sum. The time of an ending has no gradient, so the search is unsuitable for tasks that are
about this time (MountainCarContinuous, InvertedPendulum).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surrogym_server.errors import InvalidInput
from surrogym_server.local import LocalSurrogate
from surrogym_server.models.abilities import Differentiable, offers
from surrogym_server.models.port import DynamicsModel
from surrogym_server.virtual import LaneState, VirtualSettings, create, reset
from surrogym_shared.network import Network
from surrogym_shared.spec import BoxAction

SHORTEST_HORIZON, LONGEST_HORIZON = 50, 100  # bounds for a third of the time limit
LONGEST_EPISODE = 1_000  # if the specification has no time limit
START_BOX = 0.5  # share of episodes that start anywhere in the sampling range
CHECKS = 12
CHECK_LANES = 64
LARGEST_LANE = 2.0  # of the median lane's gradient, at every step backwards
NOISE = 1.0  # initial deviation of the noise before the last tanh
FIRST_SPREAD = 0.5  # deviation of the initial parameters
LAST_RATE = 0.05  # final share of the learning rate


@dataclass(frozen=True)
class GradientSettings:
    """Settings of the search. ``horizon`` None is a third of the time limit, between 50 and 100 steps."""

    updates: int = 200
    lanes: int = 128
    horizon: int | None = None
    units: int = 64
    learning_rate: float = 0.05
    largest_norm: float = 1.0
    seed: int = 0


@dataclass(frozen=True)
class Update:
    number: int
    imagined_return: float | None  # at the last check: whole episodes from the declared starts


@dataclass(frozen=True)
class Optimised:
    policy: Network
    imagined_return: float
    virtual_steps: int
    whole: bool = True  # False if Ctrl-C ended the search


def optimise(
    surrogate: LocalSurrogate,
    settings: GradientSettings | None = None,
    progress: Callable[[Update], None] | None = None,
) -> Optimised:
    """Climb the gradient of the imagined return. Returns the policy with the best imagined return.

    Args:
        surrogate: with continuous actions.
        settings: of the search.
        progress: called after every update.

    Raises:
        KeyboardInterrupt: Ctrl-C came before the first check; later it ends the search with the best policy so far.
        InvalidInput: the policy's actions are discrete, or the model's family can't be differentiated, or the return
            does not depend on the actions, for example because every step before the end has the same reward.

    Examples:
        >>> optimise(LocalSurrogate.load("spec.json", "model.safetensors")).policy.save(Path("policy.zip"))
    """
    settings = settings or GradientSettings()
    search = _Search(surrogate, settings)
    best, kept, latest, whole = -np.inf, search.policy(), None, True
    try:
        for number in range(1, settings.updates + 1):
            search.update()
            if number * CHECKS // settings.updates > (number - 1) * CHECKS // settings.updates:
                latest = search.imagined_return()
                if latest >= best:
                    best, kept = latest, search.policy()
            if progress is not None:
                progress(Update(number, latest))
    except KeyboardInterrupt:
        if latest is None:
            raise
        whole = False
    return Optimised(kept, float(best), search.virtual_steps, whole)


class _Search:
    """Parameters of a ``Network`` as one vector, Adam, and the lanes, whose starts are drawn again for each update."""

    def __init__(self, surrogate: LocalSurrogate, settings: GradientSettings) -> None:
        self._spec, self._model, self._settings = surrogate.spec(), surrogate.model, settings
        if offers(self._model, Differentiable) is None:
            family = self._model.definition.learning.model.name
            raise InvalidInput(
                f"expected a model that can be differentiated, got one of the family {family!r}: choose "
                "another algorithm"
            )
        action = self._spec.action
        if not isinstance(action, BoxAction) or action.bins is not None:
            raise InvalidInput(
                "expected continuous actions, got discrete ones, which have no gradient: choose another algorithm"
            )
        self._limit = self._spec.time_limit or LONGEST_EPISODE
        third = min(max(self._limit // 3, SHORTEST_HORIZON), LONGEST_HORIZON)
        self._horizon = min(settings.horizon or third, self._limit)
        definition = self._model.definition
        self._mean, self._deviation = definition.observation_scaling
        first = np.random.default_rng(settings.seed).normal(size=Network.size(self._spec, settings.units))
        self._vector = torch.tensor(FIRST_SPREAD * first, requires_grad=True)
        self._adam = torch.optim.Adam([self._vector], lr=settings.learning_rate)
        self._rate = torch.optim.lr_scheduler.LinearLR(self._adam, 1.0, LAST_RATE, settings.updates)
        self._training = VirtualSettings(num_envs=settings.lanes, start_box=START_BOX)
        self._random = torch.Generator().manual_seed(settings.seed)
        self._lanes = create(definition, self._training, settings.seed)
        self._check_lanes = self._checked_starts()
        self.virtual_steps = 0

    def policy(self) -> Network:
        """The present policy."""
        vector = self._vector.detach().numpy().copy()
        return Network.of(self._spec, self._mean.numpy(), self._deviation.numpy(), self._settings.units, vector)

    def update(self) -> None:
        """Take one step along the gradient of the mean return of episodes from new starts."""
        self._lanes, _ = reset(self._model.definition, self._training, self._lanes)
        returns = self._returns(self._lanes.q, self._horizon)
        if not returns.requires_grad:
            raise InvalidInput("expected a return that depends on the actions, got the same return for all actions")
        self._adam.zero_grad()
        (-returns.mean() / self._horizon).backward()  # type: ignore[no-untyped-call]
        gradient = self._vector.grad
        assert gradient is not None
        if not bool(gradient.isfinite().all()):
            gradient.zero_()  # the model is too steep after these starts; the next update has others
        torch.nn.utils.clip_grad_norm_([self._vector], self._settings.largest_norm)
        self._adam.step()
        self._rate.step()

    @torch.no_grad()
    def imagined_return(self) -> float:
        """Mean return of whole episodes, from the same declared starts at every check."""
        return float(self._returns(self._check_lanes.q, self._limit).mean())

    def _returns(self, q: Tensor, steps: int) -> Tensor:
        """Sum of rewards (N,) of ``steps`` steps from q (N, C)."""
        returns, alive = q.new_zeros(len(q)), torch.ones(len(q), dtype=torch.bool)
        for _ in range(steps):
            self.virtual_steps += len(q)
            if q.requires_grad:
                q.register_hook(_evened)  # type: ignore[no-untyped-call]
            q, reward, over = _step(self._model, q, self._act(q))
            returns = returns + torch.where(alive, reward, 0.0)
            alive = alive & ~over
            if not bool(alive.any()):
                break
        return returns

    def _act(self, q: Tensor) -> Tensor:
        """Act like ``Network``, in torch: q (N, C) to actions (N, F)."""
        d, units, size = len(self._mean), self._settings.units, self._spec.action.size
        hidden, bias, output, output_bias = torch.split(self._vector, [d * units, units, units * size, size])
        x = (self._model.definition.observe(q) - self._mean) / self._deviation
        y = torch.tanh(x @ hidden.reshape(d, units) / d**0.5 + bias) @ output.reshape(units, size) / units**0.5
        low, high = self._bounds
        if torch.is_grad_enabled():
            y = y + self._noise * torch.randn(y.shape, generator=self._random, dtype=y.dtype)
        return (low + high) / 2 + (high - low) / 2 * torch.tanh(y + output_bias)

    @property
    def _noise(self) -> float:
        """Standard deviation of the noise before the last tanh. It decays like the learning rate."""
        return NOISE * float(self._rate.get_last_lr()[0]) / self._settings.learning_rate

    @property
    def _bounds(self) -> tuple[Tensor, Tensor]:
        action = self._spec.action
        assert isinstance(action, BoxAction)
        return torch.tensor(action.low, dtype=torch.float64), torch.tensor(action.high, dtype=torch.float64)

    def _checked_starts(self) -> LaneState:
        declared = VirtualSettings(num_envs=CHECK_LANES)
        lanes = create(self._model.definition, declared, self._settings.seed)
        return reset(self._model.definition, declared, lanes)[0]


def _evened(gradient: Tensor) -> Tensor:
    """Limit the gradient (N, C) of the later steps, so that no lane outweighs the others.

    Backwards through an unstable stretch, a lane's gradient grows with every step, and would soon dominate.
    """
    size = gradient.norm(dim=1, keepdim=True)
    evened: Tensor = gradient * (LARGEST_LANE * size.median() / size.clamp_min(1e-300)).clamp_max(1.0)
    return evened


def _step(model: DynamicsModel, q: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean next state (N, C), mean reward (N,) and whether the episode ended (N,)."""
    moved = model.transition(q, u)
    over = model.terminated(moved.q_next)
    return moved.q_next, moved.reward + model.terminal_reward * over, over
