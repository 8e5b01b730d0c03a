"""Candidate feature maps (encodings of state and action as inputs of a process), and the symmetry of each.

Learning chooses among the candidates by evidence. Which ones there are depends on the environment's angles, discrete
actions, limits, lags and mirror symmetry.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import torch

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import Drift, Encoding, Feature, FeatureMap, Parity, State, features, leading
from surrogym_server.gp import Reflection

# A coordinate's range counts as centred at 0 if its middle is no farther from 0 than this share of its scale.
CENTRED = 1e-9


def reward_candidates(definition: EnvironmentDefinition) -> tuple[FeatureMap, ...]:
    """Return candidate feature maps (encodings of state and action) of the reward: of the state before the step, of the
    state after the step, or maps of both kinds, as the definition's ``reward_timing`` says.

    The observation is a candidate too if it combines coordinates, because rewards often depend on such combinations,
    for example the distance to a target.
    """
    timings = {"before": (False,), "after": (True,), "auto": (False, True)}[definition.reward_timing]
    maps = candidates(definition, follows=False, parity="even")
    if definition.observation_combines and not definition.moves_observation:
        maps += tuple(FeatureMap("observation", action) for action in dict.fromkeys(m.action for m in maps))
    return tuple(replace(m, after=after) for after in timings for m in maps)


def candidates(
    definition: EnvironmentDefinition, follows: bool, drift: Drift = (), parity: Parity = "odd"
) -> tuple[FeatureMap, ...]:
    """Return candidate feature maps (encodings of state and action) of one output. If the environment has lags
    (coordinates that repeat past values), each map also occurs with fewer past values.

    Args:
        definition: the environment.
        follows: whether the predicted next values of the leading coordinates (see ``features.leading``) may be inputs.
        drift: for each angle, weights of the coordinates that predict the angle's increment; empty without them.
        parity: symmetry that maps with mirror symmetry have: the output is an ``odd`` or ``even`` function.
    """
    if definition.moves_observation:
        return (FeatureMap(state="observation"),)
    states: list[State] = ["cos_sin"]
    if definition.angles:
        states.append("wrapped")
    actions: list[Encoding] = ["value"]
    if any(n > 2 for n in definition.action.nvec):
        actions.append("one_hot")
    leads = [False, True] if follows and leading(definition) else [False]
    maps = tuple(FeatureMap(s, a, lead) for s, a, lead in product(states, actions, leads))
    maps += tuple(replace(m, drift=drift) for m in maps if drift and m.state == "cos_sin")
    maps += (FeatureMap("none", lead=True),) if any(leads) else ()
    mirrored = (replace(m, parity=parity) for m in maps)
    maps += tuple(m for m in mirrored if reflection(definition, m) is not None)
    shorter = range(max(definition.ages))
    return maps + tuple(replace(m, history=steps) for m in maps if m.state != "none" for steps in shorter)


def reflection(definition: EnvironmentDefinition, feature_map: FeatureMap) -> Reflection | None:
    """Return the symmetry of a process with a feature map: whether each feature changes its sign if all coordinates and
    the action change their signs, and the map's parity (even or odd).

    The result is None if the map has no parity, or if a feature neither stays equal nor changes its sign. This is so
    for a coordinate whose range is not centred at 0, a one-hot action, or an observation.
    """
    if not feature_map.parity:
        return None
    signs = [_sign(definition, feature) for feature in features(definition, feature_map)]
    if not all(signs):
        return None
    parity = 1 if feature_map.parity == "even" else -1
    return Reflection(torch.tensor(signs, dtype=torch.float64, device=definition.device), parity)


def _sign(definition: EnvironmentDefinition, feature: Feature) -> int:
    """Return 1 if a feature stays the same when all coordinates and the action change their signs, -1 if the feature
    changes its sign, 0 otherwise."""
    match feature.function:
        case "cos" | "turned_cos":
            return 1
        case "sin" | "turned_sin" | "wrapped":
            return -1
        case "affine" if feature.entry >= len(definition.coordinates) and definition.action.nvec:
            # The mirror image of number i of k discrete actions is k - 1 - i, so the centred number changes its sign.
            return -1
        case "affine" | "lead":
            return -1 if abs(feature.centre) <= CENTRED * feature.scale else 0
    return 0
