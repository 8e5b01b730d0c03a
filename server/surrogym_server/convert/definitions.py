"""Conversion of a specification (names, optional fields) to an environment definition (indices, resolved defaults)."""

from __future__ import annotations

from surrogym_server.environment import definition as core
from surrogym_server.environment.observation_inverse import ObservationInverse
from surrogym_server.models.registry import GAUSSIAN_PROCESS, in_full, learner_of
from surrogym_server.plugins import Choice
from surrogym_server.sampling.acquisition import check_acquisition
from surrogym_shared import spec as wire
from surrogym_shared.rates import rates

MONTE_CARLO = 1024  # number of points that estimate the confidence index, if the specification gives no number


def definition_from_spec(spec: wire.EnvironmentSpec) -> core.EnvironmentDefinition:
    """Convert the specification of a new surrogate; fields that it leaves open get the defaults of its preset.

    Raises:
        InvalidSpec: the preset can't represent this environment, or the acquisition or the model family is not
            installed, refuses its settings, or does not fit this environment.
    """
    definition = stored_definition(spec)
    learner_of(definition.learning.model)
    check_acquisition(definition)
    return definition


def stored_definition(spec: wire.EnvironmentSpec) -> core.EnvironmentDefinition:
    """Convert the specification of a stored surrogate. This works even if its plug-ins are no longer installed.

    Raises:
        InvalidSpec: the preset can't represent this environment.
    """
    definition = core.EnvironmentDefinition(
        coordinates=spec.coordinates,
        start=tuple(spec.start[name] for name in spec.coordinate_names),
        observation=spec.observation,
        action=spec.action,
        termination_groups=spec.termination_groups,
        time_limit=spec.time_limit,
        reward=spec.reward,
        penalty=_penalty(spec),
        tolerances=tuple(spec.tolerances.items()),
        learning=core.LearningDefinition(_model(spec), spec.preset.moves, limits_rewards=spec.preset.limits_rewards),
        design=_design(spec),
        learns_termination=spec.termination == "learned",
        max_rollout=_max_rollout(spec) if spec.query == "rollout" else None,
        snapshots=spec.snapshots,
        starts=spec.starts,
        outside_reward=spec.outside_reward,
        limits=spec.limits,
        rates=rates(spec),
    )
    if definition.moves_observation:
        ObservationInverse.of(definition)
    return definition


def default_budget(spec: wire.EnvironmentSpec) -> int:
    """Return the budget of the design in real steps: that of the specification, or else that of its preset."""
    if spec.design.budget is not None:
        return spec.design.budget
    initial = _design(spec).initial
    return spec.preset.budget(initial, len(spec.coordinates), spec.action.size, spec.query == "step")


def _design(spec: wire.EnvironmentSpec) -> core.DesignDefinition:
    design, preset = spec.design, spec.preset
    by_steps = spec.query == "step" or spec.snapshots
    initial = design.initial
    if initial is None:
        sizes = len(spec.coordinates), len(spec.observation), spec.action.size
        initial = preset.initial_steps(*sizes, by_steps)
    if design.budget:
        initial = min(initial, design.budget)
    return core.DesignDefinition(
        initial=initial,
        hypercube_tries=preset.hypercube_tries,
        acquisition=_choice(design.acquisition, preset.acquisition),
        tolerance=design.tolerance or preset.tolerance,
        monte_carlo=design.monte_carlo or MONTE_CARLO,
        visited_candidates=preset.visited_candidates,
        input_probability=preset.input_probability,
        stopping=preset.stopping,
        seed=design.seed,
        trials=spec.needs_trials,
    )


def _model(spec: wire.EnvironmentSpec) -> Choice:
    """Return the model family that a specification chooses, with its settings. For ``gaussian_process``, settings that
    the specification leaves open have the values of its preset."""
    choice = in_full(_choice(spec.design.model, GAUSSIAN_PROCESS))
    if choice.name == GAUSSIAN_PROCESS:
        settings = {**spec.preset.gaussian_process, "symmetry": spec.design.symmetry, **dict(choice.settings)}
        choice = Choice(choice.name, tuple(settings.items()))
    return choice


def _choice(given: str | wire.Choice | None, usual: str) -> Choice:
    if isinstance(given, wire.Choice):
        return Choice(given.name, tuple(given.settings.items()))
    return Choice(given or usual)


def _max_rollout(spec: wire.EnvironmentSpec) -> int:
    longest = spec.max_rollout or wire.LONGEST_ROLLOUT
    return longest if spec.time_limit is None else min(longest, spec.time_limit)


def _penalty(spec: wire.EnvironmentSpec) -> float:
    if isinstance(spec.reward, wire.DeclaredReward):
        return 0.0
    return spec.preset.penalty if spec.reward.penalty is None else spec.reward.penalty
