"""Presets: values for all settings that a specification or a training leaves open.

``default`` is this product's method. ``paper`` is the method as published, changed only where it can't work.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

PresetName = Literal["default", "paper"]
Tolerance = Literal["relative", "raw"]
Moves = Literal["coordinates", "observation"]
InputProbability = Literal["uniform", "predicted"]
Stopping = Literal["confidence", "tested_confidence"]


@dataclass(frozen=True)
class Preset:
    """Values of all settings of one method, from the choice of queries to the training of a policy."""

    name: PresetName

    # Settings of the surrogate's model.
    moves: Moves  # whether the model predicts changes of coordinates, or of observation entries
    takes_declared_rewards: bool
    penalty: float  # k of eq. 14: this number of standard deviations is subtracted from a predicted reward
    limits_rewards: bool  # whether virtual rewards are limited to about the range of the samples' rewards
    gaussian_process: Mapping[str, float | bool | str]  # settings of the models of Gaussian processes, by name

    # Settings that determine how the design chooses queries (real steps).
    takes_rollouts: bool  # whether a query may be a rollout, not only a single step
    hypercube_tries: int
    acquisition: str
    tolerance: Tolerance
    visited_candidates: bool
    input_probability: InputProbability
    stopping: Stopping

    # Settings of the training of a policy, and of its audit (real steps that test the model).
    algorithm: str  # name of the training algorithm of a policy
    wide_networks: bool
    adapts_training: bool  # whether settings of a training depend on noise, episode length, and progress
    audits: bool

    def initial_steps(self, coordinates: int, observations: int, actions: int, by_steps: bool) -> int:
        """Return the default number of real steps before the first model.

        Args:
            coordinates: number of the state's coordinates.
            observations: number of the observation's entries.
            actions: number of the action's entries.
            by_steps: True if queries are single steps from states to which the environment is set, or may begin at
                saved states; False if all queries are rollouts from a reset.
        """
        if self.name == "paper":
            return 10 * (observations + actions)  # the paper's number of initial real steps, in section 3.1
        return max(4, coordinates + actions) if by_steps else 4 * (coordinates + actions)

    def budget(self, initial: int, coordinates: int, actions: int, by_steps: bool) -> int:
        """Return the default number of real steps of a design, including the ``initial`` steps.

        The preset ``paper`` takes three times the initial steps: the paper needed 125 steps in all with 40 initial
        steps, and 120 with 50. Arguments other than ``initial`` are those of ``initial_steps``.
        """
        if self.name == "paper":
            return 3 * initial
        return max((10 if by_steps else 20) * (coordinates + actions), initial)


DEFAULT = Preset(
    name="default",
    moves="coordinates",
    takes_declared_rewards=True,
    penalty=0.0,
    limits_rewards=True,
    gaussian_process=MappingProxyType(
        {
            "kernel": "composite",
            "reward_jumps": True,
            "reward_peaks": True,
            "rates": True,
            "drop_inputs": True,
            "repeated_parts": True,
        }
    ),
    takes_rollouts=True,
    hypercube_tries=50,
    acquisition="integrated_variance",
    tolerance="relative",
    visited_candidates=True,
    input_probability="uniform",
    stopping="tested_confidence",
    algorithm="FASTPPO",
    wide_networks=True,
    adapts_training=True,
    audits=True,
)

PAPER = Preset(
    name="paper",
    moves="observation",
    takes_declared_rewards=False,
    penalty=3.0,
    limits_rewards=False,
    gaussian_process=MappingProxyType(
        {
            "kernel": "squared_exponential",
            "reward_jumps": False,
            "reward_peaks": False,
            "rates": False,
            "drop_inputs": False,
            "repeated_parts": False,
        }
    ),
    takes_rollouts=False,
    hypercube_tries=1,
    acquisition="uncertainty_index",
    tolerance="raw",
    visited_candidates=False,
    input_probability="predicted",
    stopping="confidence",
    algorithm="PPO",
    wide_networks=False,
    adapts_training=False,
    audits=False,
)

PRESETS: Mapping[PresetName, Preset] = MappingProxyType({"default": DEFAULT, "paper": PAPER})
