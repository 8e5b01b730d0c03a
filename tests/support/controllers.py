"""Policies that never learned, for deployment: seeded random weights, in every form that a controller can have."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import stable_baselines3
import torch
from gymnasium import spaces

from surrogym_shared.network import Layer, Network
from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    DeclaredReward,
    DiscreteAction,
    EnvironmentSpec,
    Limit,
    Limits,
    MultiDiscreteAction,
    ObservationEntry,
    Quantity,
    RewardTerm,
    Term,
    Uniform,
    with_history,
)
from surrogym_shared.spec.coordinates import Bounds
from surrogym_trainer.policies.card import PolicyCard, write_card
from surrogym_trainer.policies.networks import PaperPolicy

TORQUES = BoxAction(low=(-2.0, 0.0), high=(2.0, 10.0))
LEARNERS = {
    "PPO, standardised": ("PPO", PaperPolicy, TORQUES, {}),
    "PPO, noise by the state": ("PPO", PaperPolicy, TORQUES, {"use_sde": True}),
    "PPO, discrete": ("PPO", PaperPolicy, DiscreteAction(n=3), {}),
    "A2C, several discrete": ("A2C", "MlpPolicy", MultiDiscreteAction(nvec=(2, 3)), {}),
    "PPO, bins": ("PPO", "MlpPolicy", BoxAction(low=(-2.0,), high=(1.0,), bins=(7,)), {}),
    "SAC": ("SAC", "MlpPolicy", TORQUES, {}),
    "TD3": ("TD3", "MlpPolicy", TORQUES, {}),
    "DQN": ("DQN", "MlpPolicy", DiscreteAction(n=3), {}),
}


def plant(action: Any = TORQUES, **history: Any) -> EnvironmentSpec:
    """Specification of an arm whose angle and slide are measured, with a bound, a clipped term and a setpoint."""
    spec = EnvironmentSpec(
        environment="arm",
        coordinates=(
            Coordinate(name="angle", kind="angle", sampling=Uniform(low=-3.0, high=3.0), unit="rad"),
            Coordinate(name="slide", sampling=Uniform(low=-1.0, high=2.0), bounds=Bounds(low=-1.0, high=2.0), unit="m"),
            Coordinate(name="target", kind="constant", sampling=Uniform(low=0.0, high=1.0), unit="m"),
        ),
        observation=(
            ObservationEntry(name="cos", term=Term.cos(angle=1), low=-1, high=1),
            ObservationEntry(name="sin", term=Term.sin(angle=1), low=-1, high=1),
            ObservationEntry(name="slide", term=Term.linear(slide=1)),
            ObservationEntry(
                name="miss", term=(Term.linear(slide=2, target=-1) + Term.constant(0.1)).clipped(-1.5, None)
            ),
        ),
        action=action,
        start={"angle": Uniform(low=-3, high=3), "slide": Uniform(low=0, high=1), "target": Uniform(low=0, high=1)},
        time_limit=40,
        sampling_period=0.05,
        query="rollout",
    )
    return with_history(spec, **history) if history else spec


def limited(spec: EnvironmentSpec) -> EnvironmentSpec:
    """The same plant, whose slide and a mixed term must keep limits."""
    mixed = (Term.linear(slide=1.0, target=1.0) + Term.sin(angle=0.5)).clipped(-3.0, 5.0)
    limits = Limits(
        keep=(
            Limit(name="slide", term=Term.linear(slide=1.0), low=-0.9, high=1.9, margin=0.3),
            Limit(name="mixed", term=mixed, low=-2.5, margin=0.2),
        ),
        fallback=(Term.linear(slide=-2.0).clipped(-1.5, None), Term.constant(1.0) + Term.cos(angle=1.0)),
    )
    return EnvironmentSpec.model_validate({**spec.model_dump(), "limits": limits.model_dump()})


def holding(spec: EnvironmentSpec) -> EnvironmentSpec:
    """The same plant, whose reward says that the slide is to be held at 0.4 m."""
    error = Quantity(term=Term.linear(slide=1) + Term.constant(-0.4))
    reward = DeclaredReward(kind="declared", terms=(RewardTerm(shape="bump", of=(error,)),))
    return spec.model_copy(update={"reward": reward})


def network(folder: Path, spec: EnvironmentSpec, units: Any = (64, 64), gain: float = 1.0, **card: Any) -> Path:
    """A file of a network of arrays with random weights, and a card with the specification. The network sees the
    integrals of the card's settings, too."""
    more = (
        ObservationEntry(name=name, term=Term.constant(0.0)) for name in card.get("settings", {}).get("integral", ())
    )
    shown = spec.model_copy(update={"observation": (*spec.observation, *more)})
    d, rng = len(shown.observation), np.random.default_rng(0)
    weights = gain * rng.normal(size=Network.size(shown, units))
    made = Network.of(shown, rng.normal(size=d), rng.uniform(0.5, 2.0, d), units, weights)
    small = tuple(Layer(layer.weights, 0.1 * layer.bias) for layer in made.layers)  # else one choice is always the best
    replace(made, layers=small).save(folder / "policy.zip")
    write_card(folder / "policy.zip", PolicyCard(surrogate="arm", spec=spec, **card))
    return folder / "policy.zip"


class Idle(gymnasium.Env):
    """Something to build an algorithm on."""

    def __init__(self, spec: EnvironmentSpec) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (len(spec.observation),), np.float32)
        match spec.action:
            case BoxAction(bins=None, low=low, high=high):
                self.action_space = spaces.Box(np.float32(low), np.float32(high))
            case BoxAction(bins=(one,)):
                self.action_space = spaces.Discrete(one)
            case DiscreteAction(n=n):
                self.action_space = spaces.Discrete(n)
            case MultiDiscreteAction(nvec=nvec):
                self.action_space = spaces.MultiDiscrete(nvec)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(self.observation_space.shape, np.float32), {}

    def step(self, action):
        return np.zeros(self.observation_space.shape, np.float32), 0.0, False, False, {}


def learner(folder: Path, case: str, spec: EnvironmentSpec) -> Path:
    """A file of a Stable-Baselines3 policy whose weights differ from a fresh one's, so that each of them counts."""
    algorithm, policy, _, options = LEARNERS[case]
    d = len(spec.observation)
    standardised = {"mean": list(np.arange(d, dtype=float)), "deviation": list(1.0 + np.arange(d))}
    if policy is PaperPolicy:
        options = options | {"policy_kwargs": {"features_extractor_kwargs": standardised}}
    made = getattr(stable_baselines3, algorithm)(policy, Idle(spec), device="cpu", seed=0, **options)
    generator = torch.Generator().manual_seed(2)
    with torch.no_grad():
        for parameter in made.policy.parameters():
            size = 1.5 / parameter.shape[-1] ** 0.5 if parameter.ndim > 1 else 0.05
            parameter += size * torch.randn(parameter.shape, generator=generator)
    made.save(folder / "policy.zip")
    write_card(folder / "policy.zip", PolicyCard(algorithm=algorithm, surrogate="arm", spec=spec))
    return folder / "policy.zip"
