"""Conversion of a policy file to a controller: networks of arrays, and Stable-Baselines3 policies of one network.

Shapes: D observation entries, A outputs, F action entries.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from surrogym_sampler.original.actions import decode_actions
from surrogym_sampler.original.fitting import check_policy
from surrogym_shared.integrals import errors_of
from surrogym_shared.network import Network
from surrogym_shared.spec import EnvironmentSpec
from surrogym_trainer.deployment.controller import (
    Activation,
    Array,
    Choices,
    Controller,
    Decision,
    Dense,
    NotDeployable,
    controller_from,
)
from surrogym_trainer.deployment.reference import act, scores
from surrogym_trainer.policies.card import UnusablePolicy, read_card
from surrogym_trainer.policies.files import ONNX, load_network, load_policy, require_policy
from surrogym_trainer.policies.planner_files import PlannerFile
from surrogym_trainer.policies.predict import Predict

if TYPE_CHECKING:
    from torch import nn

CHECKS = 1_000  # number of random observations on which the controller is compared with the policy
# largest accepted difference of the actions of controller and policy, as a share of their range; torch computes in
# float32
TOLERANCE = 1e-4
CAN = (
    "a deterministic feed-forward network can be deployed: a policy of surrogym train, or one of PPO, A2C, SAC, TD3, "
    "DDPG or DQN with layers of tanh or ReLU"
)


def controller_of(
    policy: Path,
    spec: EnvironmentSpec | None = None,
    algorithm: str | None = None,
    *,
    trust: bool = False,
    choices: Choices | None = None,
) -> Controller:
    """Return the controller of a policy, checked against the policy itself on random observations.

    Args:
        policy: file from ``surrogym train`` or Stable-Baselines3.
        spec: the specification that it was trained for; None takes that of its card.
        algorithm: name of the Stable-Baselines3 class; None takes the card's. A network of arrays needs none.
        trust: whether to unpickle the policy's objects, which runs any code that is in them.
        choices: a person's settings, such as fallback, timeout and ranges.

    Raises:
        NotDeployable: the policy has another form or needs ``trust``, no specification is known, or a setting does not
            fit.
        UnusablePolicy: the file or its card is damaged.
        PolicyMisfit: the card has another specification.
    """
    require_policy(policy)
    if policy.suffix.lower() == ONNX:
        raise NotDeployable(f"{policy} is an export without its network: expected the policy's zip file; {CAN}")
    card = read_card(policy)
    meant = spec or card.spec
    if meant is None:
        raise NotDeployable(
            f"expected --spec with the specification that {policy} was trained for, because no card beside it has one: "
            "surrogym describe drafts it"
        )
    if card.spec is not None:
        check_policy(card.spec, meant)
    chosen = algorithm or card.algorithm
    decision, predict = _network(policy, chosen, trust=trust)
    digests = {
        "policy": hashlib.sha256(policy.read_bytes()).hexdigest(),
        "specification": hashlib.sha256(meant.model_dump_json().encode()).hexdigest(),
        **({"samples of the model": card.model} if card.model else {}),
    }
    name = card.surrogate or policy.stem
    errors = errors_of(meant, card.integral, card.set_points)
    controller = controller_from(meant, decision, name, digests, choices or Choices(), errors)
    _check(controller, meant, predict)
    return controller


def _network(policy: Path, algorithm: str, *, trust: bool) -> tuple[Decision, Predict]:
    """Return the network of a policy file, and the policy as a function of observations."""
    if Network.is_at(policy):
        network = load_network(policy)
        return _of_arrays(network), network
    if PlannerFile.is_at(policy):
        raise NotDeployable(f"{policy} is a planner, which has no network; {CAN}")
    try:
        predict = load_policy(policy, algorithm, trust=trust)
    except UnusablePolicy as error:
        raise NotDeployable(f"{error}; {CAN}") from error
    return _of_learner(policy, algorithm, trust=trust), predict


def _of_arrays(network: Network) -> Decision:
    *hidden, last = network.layers
    dense = [Dense(_doubles(w), _doubles(b), network.activation) for w, b in hidden]
    dense.append(Dense(_doubles(last.weights), _doubles(last.bias), "none"))
    low, high = (np.zeros(0), np.zeros(0)) if network.counts else (network.low, network.high)
    return Decision(
        mean=_doubles(network.mean),
        deviation=_doubles(network.deviation),
        clip=np.inf,
        layers=tuple(dense),
        counts=network.counts,
        squash=not network.counts,
        centre=(low + high) / 2,
        reach=(high - low) / 2,
    )


def _of_learner(policy: Path, algorithm: str, *, trust: bool) -> Decision:
    """Return the network of a Stable-Baselines3 policy.

    Raises:
        NotDeployable: the policy has parts that are not layers, a clip or a scale.
    """

    from surrogym_trainer.policies.files import Normalisation, is_normalised, read_learner, statistics_path

    learner = read_learner(policy, algorithm, trust, {})
    observed, acted = learner.observation_space, learner.action_space
    if not isinstance(observed, spaces.Box) or len(observed.shape) != 1:
        raise NotDeployable(f"expected a policy whose observation is a vector, got one of {observed}; {CAN}")
    modules, squash, bounded = _actor(learner.policy)
    mean, deviation, clip = np.zeros(observed.shape), np.ones(observed.shape), np.inf
    if (extractor := _standardise(learner.policy)) is not None:
        mean, deviation = _doubles(extractor.mean), _doubles(extractor.deviation)
    if is_normalised(learner):
        if extractor is not None:
            raise NotDeployable(f"expected a policy with one normalisation of observations, got two; {CAN}")
        statistics = Normalisation(statistics_path(policy))
        clip = float(statistics.clip)
        mean, deviation = (np.broadcast_to(a, observed.shape) for a in (statistics.mean, statistics.spread))
    centre, reach, counts = np.zeros(0), np.zeros(0), _choices(acted)
    if isinstance(acted, spaces.Box):
        low, high = _doubles(acted.low), _doubles(acted.high)
        centre = (low + high) / 2 if squash else np.zeros(len(low))
        reach = (high - low) / 2 if squash else np.ones(len(low))
    if bounded is not None:
        centre, reach, squash = _doubles(bounded.centre), _doubles(bounded.reach), True
    return Decision(mean, deviation, clip, _dense(modules), counts, squash and not counts, centre, reach)


def _choices(acted: Any) -> tuple[int, ...]:
    """Return the number of choices of each entry of an action space; empty for a continuous one.

    Raises:
        NotDeployable: the space is neither continuous nor discrete from 0.
    """

    match acted:
        case spaces.Box(shape=(_,)):
            return ()
        case spaces.Discrete(start=0):
            return (int(acted.n),)
        case spaces.MultiDiscrete() if acted.nvec.ndim == 1 and not acted.start.any():
            return tuple(int(n) for n in acted.nvec)
        case _:
            raise NotDeployable(f"expected continuous or numbered actions, got {acted}; {CAN}")


def _actor(policy: Any) -> tuple[list[nn.Module], bool, Any]:
    """Return the modules of the policy from the observation to the outputs.

    Returns:
        The modules in order; whether a tanh and a scale follow them; and the module that contains both, or None.

    Raises:
        NotDeployable: the policy is of another class.
    """
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.dqn.policies import DQNPolicy
    from stable_baselines3.sac.policies import SACPolicy
    from stable_baselines3.td3.policies import TD3Policy

    from surrogym_trainer.policies.networks import Bounded

    kind = next((k for k in (ActorCriticPolicy, SACPolicy, TD3Policy, DQNPolicy) if isinstance(policy, k)), None)
    if kind is ActorCriticPolicy:
        *modules, last = [*_flat(policy.mlp_extractor.policy_net), *_flat(policy.action_net)]
        if isinstance(last, Bounded):
            return modules, False, last
        return [*modules, last], bool(policy.squash_output), None
    if kind is SACPolicy:
        return [*_flat(policy.actor.latent_pi), *_flat(policy.actor.mu)], True, None
    if kind is TD3Policy:
        *modules, _ = _flat(policy.actor.mu)  # the last module is the tanh, which the controller applies by itself
        return modules, True, None
    if kind is DQNPolicy:
        return list(_flat(policy.q_net.q_net)), False, None
    raise NotDeployable(f"expected a policy of one network, got {type(policy).__name__}; {CAN}")


def _standardise(policy: Any) -> Any:
    """Return the layer that standardises observations; None if there is none.

    Raises:
        NotDeployable: observations pass through another layer.
    """
    from stable_baselines3.common.torch_layers import FlattenExtractor

    from surrogym_trainer.policies.networks import Standardise

    owners = (getattr(policy, name, None) for name in ("actor", "q_net"))
    owner = next((one for one in owners if one is not None), policy)
    extractor = getattr(owner, "pi_features_extractor", owner.features_extractor)
    if isinstance(extractor, Standardise):
        return extractor
    if isinstance(extractor, FlattenExtractor):
        return None
    raise NotDeployable(
        f"expected a policy whose observations enter the network directly, got {type(extractor).__name__}; {CAN}"
    )


def _flat(module: nn.Module) -> Iterable[nn.Module]:
    from torch import nn

    return module if isinstance(module, nn.Sequential) else [module]


def _dense(modules: Iterable[nn.Module]) -> tuple[Dense, ...]:
    """Convert torch modules to layers.

    Raises:
        NotDeployable: a module is not a linear layer, tanh or ReLU.
    """
    from torch import nn

    found: list[Dense] = []
    names: dict[type, Activation] = {nn.Tanh: "tanh", nn.ReLU: "relu"}
    for module in modules:
        if isinstance(module, nn.Linear):
            weights = _doubles(module.weight.T)
            bias = np.zeros(weights.shape[1]) if module.bias is None else _doubles(module.bias)
            found.append(Dense(weights, bias, "none"))
        elif type(module) in names and found and found[-1].activation == "none":
            found[-1] = Dense(found[-1].weights, found[-1].bias, names[type(module)])
        else:
            raise NotDeployable(f"expected layers of tanh or ReLU, got {type(module).__name__}; {CAN}")
    return tuple(found)


def _check(controller: Controller, spec: EnvironmentSpec, predict: Predict) -> None:
    """Compare the controller with the policy on random observations.

    Different choices whose scores are equal up to rounding are accepted.

    Raises:
        NotDeployable: the actions differ.
    """
    decision, size = controller.decision, len(controller.observation)
    drawn = decision.mean + 3 * decision.deviation * np.random.default_rng(0).standard_normal((CHECKS, size))
    observations = drawn.astype(np.float32)
    try:
        expected = decode_actions(spec, predict(observations), CHECKS)
    except ValueError as error:  # torch refuses a distribution of NaN
        raise NotDeployable(
            "expected a policy with finite actions, got NaN or infinity, because its weights overflow: train it again"
        ) from error
    shown = observations.astype(np.float64)
    got, _ = act(controller, shown)
    wrong = np.abs(got - expected) > TOLERANCE * (controller.high - controller.low)
    if decision.counts:
        wrong &= ~_close(scores(decision, shown), decision.counts)
    if wrong.any():
        largest = np.abs(got - expected)[wrong].max()
        raise NotDeployable(f"the controller's actions differ from the policy's by up to {largest:g}; {CAN}")


def _close(y: Array, counts: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return a mask (N, F) of the discrete action entries whose two largest scores are equal up to rounding.

    The network's outputs y (N, A) have a score for each of an entry's choices, whose numbers are ``counts``.
    """
    groups = np.split(y, np.cumsum(counts)[:-1], axis=1)
    best = [np.sort(group, axis=1)[:, -2:] for group in groups]
    return np.stack([b[:, 1] - b[:, 0] <= TOLERANCE * (1 + np.abs(b[:, 1])) for b in best], axis=1)


def _doubles(values: Any) -> Array:
    """Return an array or a tensor as a float64 array."""
    array = values.detach().numpy() if hasattr(values, "detach") else values
    return np.array(array, dtype=np.float64)
