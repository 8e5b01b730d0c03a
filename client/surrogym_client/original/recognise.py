"""A specification for a MuJoCo environment that nobody has described yet, found without taking a single step.

The state is set at random places and the observation read there; each entry is fitted by least squares on the
terms a specification can express: 1, q, sin and cos of hinges and their sums. What is left over is refused.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np

from surrogym_client.original.errors import UnknownEnvironment
from surrogym_client.original.mujoco import VELOCITY, Joints, open_mujoco
from surrogym_client.original.protocol import Array, Native
from surrogym_client.original.terms import evaluate
from surrogym_shared.spec import (
    AllOf,
    BoxAction,
    Coordinate,
    EnvironmentSpec,
    ObservationEntry,
    Reward,
    Term,
    Uniform,
)

HINGE = 3  # mjJNT_HINGE
TOLERANCE = 1e-7


def recognise(
    name: str, ranges: Mapping[str, tuple[float, float]], termination: tuple[AllOf, ...] = ()
) -> EnvironmentSpec:
    """Write the specification of a Gymnasium MuJoCo environment.

    Args:
        name: a Gymnasium id.
        ranges: sampling range of each coordinate, named after its joint or ``<joint>_velocity``; limited
            joints may be left out and take the model's limits.
        termination: any of these all-of groups ends an episode; it can't be read off the model.

    Raises:
        UnknownEnvironment: a range is missing, or an observation entry is no sum of terms.

    Examples:
        >>> speeds = {"slider_velocity": (-3, 3), "hinge_velocity": (-6, 6)}
        >>> recognise("InvertedPendulum-v5", speeds).observation[0].name
        'o0'
    """
    import gymnasium

    env = open_mujoco(name)
    coordinates = tuple(_coordinates(env, Joints(env), ranges))
    frame = EnvironmentSpec(
        environment=name,
        coordinates=coordinates,
        observation=(ObservationEntry(name="unknown", term=Term.constant(0)),),
        action=_action(env),
        start={c.name: _around_rest(env, c) for c in coordinates},
        termination=termination,
        time_limit=gymnasium.spec(name).max_episode_steps,
        reward=Reward(timing="after"),
    )
    terms = _observation_terms(env, frame)
    entries = tuple(ObservationEntry(name=f"o{i}", term=term) for i, term in enumerate(terms))
    return EnvironmentSpec.model_validate({**frame.model_dump(), "observation": entries})


def _coordinates(env: Native, joints: Joints, ranges: Mapping[str, tuple[float, float]]) -> list[Coordinate]:
    given = {name: (float(low), float(high)) for name, (low, high) in ranges.items()}
    model = env.model
    limits = {
        name: tuple(map(float, model.jnt_range[i])) for i, name in enumerate(joints.names) if model.jnt_limited[i]
    }
    names = [*joints.names, *(name + VELOCITY for name in joints.names)]
    joints.columns(tuple(given))
    missing = [name for name in names if name not in given and name not in limits]
    if missing:
        raise UnknownEnvironment(f"ranges lack {missing}: the model gives no limits for them")
    return [
        Coordinate(name=name, sampling=Uniform(low=low, high=high))
        for name in names
        for low, high in [given.get(name) or limits[name]]
    ]


def _around_rest(env: Native, coordinate: Coordinate) -> Uniform:
    joints = Joints(env)
    env.set_state(env.init_qpos, env.init_qvel)
    rest = float(joints.read(joints.columns((coordinate.name,)))[0])
    return Uniform(low=rest - 0.01, high=rest + 0.01)


def _action(env: Native) -> BoxAction:
    space = env.action_space
    return BoxAction(low=tuple(map(float, space.low)), high=tuple(map(float, space.high)))


def _observation_terms(env: Native, frame: EnvironmentSpec) -> list[Term]:
    basis = _basis(env, frame)
    joints = Joints(env)
    columns = joints.columns(frame.coordinate_names)
    places = _places(frame, count=4 * len(basis) + 16)
    observed = np.stack([_observe_at(env, joints, columns, place) for place in places])
    design = np.stack([evaluate(frame, term, places) for term in basis], axis=1)
    weights: Array = np.linalg.lstsq(design, observed, rcond=None)[0].astype(np.float64)
    error = np.abs(design @ weights - observed).max(axis=0)
    strange = [i for i, e in enumerate(error) if e > TOLERANCE]
    if strange:
        raise UnknownEnvironment(
            f"observation entries {strange} of {frame.environment} are no sums of 1, q, sin and cos "
            "within the given ranges, so no specification can express them"
        )
    return [_sum(basis, weights[:, i]) for i in range(observed.shape[1])]


def _basis(env: Native, frame: EnvironmentSpec) -> list[Term]:
    hinges = [c.name for c, kind in zip(frame.coordinates, env.model.jnt_type, strict=False) if kind == HINGE]
    linear = [Term.linear(**{name: 1.0}) for name in frame.coordinate_names]
    angles = [{name: 1.0} for name in hinges] + [{a: 1.0, b: 1.0} for a, b in itertools.combinations(hinges, 2)]
    circular = [term for weights in angles for term in (Term.sin(**weights), Term.cos(**weights))]
    return [Term.constant(1.0), *linear, *circular]


def _places(frame: EnvironmentSpec, count: int) -> Array:
    rng = np.random.default_rng(0)
    boxes = [c.sampling for c in frame.coordinates if isinstance(c.sampling, Uniform)]
    return rng.uniform([b.low for b in boxes], [b.high for b in boxes], (count, len(boxes)))


def _observe_at(env: Native, joints: Joints, columns: list[int], place: Array) -> Array:
    joints.write(columns, place)
    return np.asarray(env._get_obs(), dtype=np.float64)


def _sum(basis: list[Term], weights: Array) -> Term:
    kept = [(term, float(np.round(w, 9))) for term, w in zip(basis, weights, strict=True) if abs(w) > TOLERANCE]
    parts = tuple(part for term, weight in kept for part in (weight * term).parts)
    return Term(parts=parts) if parts else Term.constant(0)
