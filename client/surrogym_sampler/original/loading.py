"""Functions that make an original environment from a name: one that an adapter knows, or a user's
``package.module:factory``."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import gymnasium
from pydantic import ValidationError

import surrogym_shared.spec
from surrogym_sampler.original.actions import require_same_action
from surrogym_sampler.original.adapters import adapter_of, is_trusted, open_simulator, with_colon
from surrogym_sampler.original.classic import TASKS
from surrogym_sampler.original.errors import OriginalError, UnknownEnvironment, sentence
from surrogym_sampler.original.executables import Executable, is_executable, open_executable
from surrogym_sampler.original.factories import load_factory
from surrogym_sampler.original.gymnasium import GymnasiumEnvironment, opens_task, task_for
from surrogym_sampler.original.isolated import IsolatedEnvironment
from surrogym_sampler.original.mujoco_tasks import SPECIFICATIONS
from surrogym_sampler.original.periods import period_of, require_period
from surrogym_sampler.original.protocol import LONGEST_EPISODE, Environment
from surrogym_sampler.original.rollouts import answering, keeping_limits
from surrogym_sampler.original.simulator import Simulated
from surrogym_shared.environments import is_name, is_same
from surrogym_shared.faults import first_fault
from surrogym_shared.presets import PresetName
from surrogym_shared.spec import Access, BoxAction, EnvironmentSpec

Choose = Callable[[EnvironmentSpec], EnvironmentSpec]
ACCESS: dict[Access, dict[str, Any]] = {  # Fields of a specification for each kind of access (where a query may begin).
    "any": {"query": "step", "snapshots": False},
    "snapshot": {"query": "rollout", "snapshots": True},
    "reset": {"query": "rollout", "snapshots": False},
}
PLACEHOLDER = "YOUR.MODULE:CLASS"  # stands in a suggested command for the name of an environment that is not known
ATTRIBUTES = (
    *("step_from", "reset", "step", "coordinates", "begin", "act", "save", "restore"),
    *("picture", "close", "parallel", "steps_from"),
)


def make(
    name: str,
    *,
    spec: EnvironmentSpec | None = None,
    preset: PresetName | None = None,
    budget: int | None = None,
    initial: int | None = None,
    target: float | None = None,
    acquisition: str | None = None,
    seed: int | None = None,
    bins: int | None = None,
    access: Access | None = None,
    max_rollout: int | None = None,
    step_limit: float = 30.0,
) -> Environment:
    """Make an original environment.

    Args:
        name: a Gymnasium id, ``dm_control:DOMAIN-TASK``, ``pcgym:MODEL``, ``fmu:PLANT.fmu``, ``mujoco:FILE.xml``,
            ``exec:COMMAND``, or
            ``package.module:factory``.
        spec: a specification that replaces the adapter's own; most names have none until ``describe`` writes one.
        preset, budget, initial, target, acquisition, seed: settings of the design; None keeps the specification's.
        bins: number of discrete values that replace each dimension of a continuous action for policies.
        access: where a query may begin: at ``any`` state, at a ``snapshot`` or a reset, or at a ``reset`` only. None
            keeps the specification's.
        max_rollout: largest number of actions in a query that begins at a reset or snapshot.
        step_limit: seconds that one step of ``exec:COMMAND`` or ``fmu:PLANT.fmu`` may take; the function ``isolated``
            limits the steps of other environments.

    Raises:
        UnknownEnvironment: no adapter knows the name, or its module or factory can't be found.
        ValueError: the options contradict the specification.

    Examples:
        >>> make("CartPole-v1", preset="paper").spec().time_limit
        200
    """
    asked = {"budget": budget, "initial": initial, "target": target, "acquisition": acquisition, "seed": seed}
    chosen = {key: value for key, value in {"preset": preset, **asked}.items() if value is not None}
    choose = partial(with_choices, design=chosen, bins=bins, access=access, max_rollout=max_rollout)
    if is_executable(name):
        return open_executable(name, spec, choose, step_limit)
    if is_own(name):
        return _own(name, _made(name), spec, choose)
    return _known(name, spec, choose, preset or "default", step_limit)


def isolated(
    name: str, step_limit: float, spec: EnvironmentSpec | None = None, fallback: str | None = None
) -> IsolatedEnvironment | Executable | Simulated:
    """Make an original environment in a process of its own, in which a step may take ``step_limit`` seconds.

    ``fallback`` gives the program of the fallback that the specification's limits name, as
    NAME=package.module:function.
    """
    if is_executable(name):
        return open_executable(name, spec, step_limit=step_limit)
    if (adapter := adapter_of(name)) is not None and adapter.separate:
        made = make(name, spec=spec, step_limit=step_limit)
        assert isinstance(made, Simulated)
        return made
    return IsolatedEnvironment(partial(make, name, spec=spec), step_limit, fallback)


def for_queries(
    name: str, step_limit: float, spec: EnvironmentSpec | None = None, fallback: str | None = None
) -> Environment:
    """Make an original environment as ``isolated`` does, but one that keeps the limits of its specification."""
    made = isolated(name, step_limit, spec, fallback)
    # an IsolatedEnvironment keeps the declared limits in its child process
    return made if isinstance(made, IsolatedEnvironment) else keeping_limits(made, fallback)


def is_own(name: str) -> bool:
    """Return whether a name has the form ``package.module:factory`` or ``exec:COMMAND``, and no adapter knows it."""
    return ":" in name and adapter_of(name) is None


def is_known(name: str) -> bool:
    """Return whether a name that came from a server may be opened without consent: an adapter knows it, and it runs no
    user's code."""
    entry = gymnasium.registry.get(name)
    its_own = entry is not None and str(entry.entry_point).startswith("gymnasium.envs.mujoco.")
    return name in TASKS or its_own or is_trusted(name)


def env_option(name: str) -> str:
    """Return the option ``--env`` that a suggested command needs, with a space before it; empty if the name alone opens
    the environment.

    A program's command is never repeated, because the name may come from a server.
    """
    if is_known(name):
        return ""
    if is_executable(name):
        return " --env exec:COMMAND"
    return f" --env {shlex.quote(name) if is_name(name) else PLACEHOLDER}"


def sample_command(surrogate: str, environment: str) -> str:
    """Return the command that starts a sampler of a surrogate whose environment has this name."""
    return f"surrogym sample {surrogate}{env_option(environment)}"


def has_specification(name: str) -> bool:
    """Return whether an environment comes with a specification, built in or from its class."""
    return name in TASKS or name in SPECIFICATIONS or adapter_of(name) is None


def specification(name: str) -> EnvironmentSpec:
    """Return the built-in specification of a name.

    Raises:
        UnknownEnvironment: there is none.
    """
    if name in SPECIFICATIONS:
        return SPECIFICATIONS[name]()
    known = ", ".join((*TASKS, *SPECIFICATIONS))
    if adapter_of(name) is None:
        raise UnknownEnvironment(
            f"no adapter knows the environment {name!r}: expected one of {known}, another Gymnasium id, "
            "dm_control:DOMAIN-TASK, pcgym:MODEL, fmu:PLANT.fmu, mujoco:FILE.xml, package.module:factory, or "
            "exec:COMMAND for a program" + with_colon(name)
        )
    open_simulator(name).close()
    raise UnknownEnvironment(
        f"{name} has no built-in specification (built in: {known}): surrogym describe {name} > env.json writes "
        "one, and --spec env.json uses it"
    )


def fits(noted: str, name: str) -> bool:
    """Return whether the specification of the environment ``noted`` may be used for the environment ``name``, which an
    adapter opens. It may if both names stand for the same environment, and this environment is built in or has no
    specification of its own."""
    return is_same(noted, name) and (is_known(name) or not has_specification(name))


def own_time_limit(name: str) -> int:
    """Return the time limit in steps with which Gymnasium registers a known environment; ``LONGEST_EPISODE`` if there
    is none."""
    if name in gymnasium.registry:
        return gymnasium.spec(name).max_episode_steps or LONGEST_EPISODE
    simulator = open_simulator(name)
    simulator.close()
    return simulator.time_limit or LONGEST_EPISODE


def with_choices(
    spec: EnvironmentSpec,
    design: Mapping[str, Any],
    bins: int | None = None,
    access: Access | None = None,
    max_rollout: int | None = None,
) -> EnvironmentSpec:
    """Return the specification with changed settings of its design and other options of ``make``, validated again.

    Args:
        spec: the specification.
        design: settings of the design to replace.
        bins: number of discrete values for each dimension of a continuous action; None changes nothing.
        access: where a query may begin; None changes nothing.
        max_rollout: largest number of actions in a query; None changes nothing.

    Raises:
        ValueError: the options contradict the specification.
    """
    fields = spec.model_dump()
    fields["design"].update(design)
    if bins is not None:
        if not isinstance(spec.action, BoxAction):
            raise ValueError(f"bins need a continuous action, got a {spec.action.kind} one: leave bins out")
        fields["action"]["bins"] = (bins,) * spec.action.size
    if access is not None:
        fields |= ACCESS[access]
    if max_rollout is not None:
        fields["max_rollout"] = max_rollout
    return EnvironmentSpec.model_validate(fields)


def _known(name: str, spec: EnvironmentSpec | None, choose: Choose, preset: str, step_limit: float) -> Environment:
    if spec is not None and spec.environment and not is_same(spec.environment, name):
        raise UnknownEnvironment(
            f"expected a specification of {name}, got one of {spec.environment}: if it describes {name} as well, write "
            f'"environment": "{name}" in it'
        )
    if opens_task(name, spec):
        spec = spec and spec.model_copy(update={"environment": name})
        base = spec or task_for(name, preset).spec()
        made = choose(base)
        require_same_action(name, made.action, TASKS[name].spec().action)
        environment = GymnasiumEnvironment(made)
        require_period(name, made, environment.period)
        return environment
    base = choose(spec or specification(name))
    own = name in SPECIFICATIONS and SPECIFICATIONS[name]().observation == base.observation
    simulator = open_simulator(name)
    try:
        require_same_action(name, base.action, simulator.action)
        simulator.require_period(name, base)
        return simulator.with_specification(base, shows_own=own, step_limit=step_limit)
    except UnknownEnvironment as error:
        simulator.close()
        if name not in TASKS:
            raise
        raise UnknownEnvironment(
            f"{error}; or give a specification with the coordinates of Surrogym's built-in task, "
            f"{', '.join(TASKS[name].spec().coordinate_names)}, in this order"
        ) from error
    except BaseException:
        simulator.close()
        raise


class Respecified:
    """A user's environment whose specification is replaced by another one."""

    def __init__(self, environment: object, spec: EnvironmentSpec) -> None:
        self._spec = spec
        self.wrapped = environment  # ``priors.calibration`` reads this attribute
        for name in ATTRIBUTES:
            if hasattr(environment, name):
                setattr(self, name, getattr(environment, name))

    def spec(self) -> EnvironmentSpec:
        return self._spec


def _made(name: str) -> Any:
    """Make a user's environment by its factory. Raises ``UnknownEnvironment`` if there is no factory, or if it fails or
    calls ``sys.exit``."""
    factory = load_factory(name)
    try:
        return _called(f"{name} failed while it was made", factory)
    except SystemExit as error:
        raise UnknownEnvironment(
            f"{name} called sys.exit while it was made: {sentence(error)}; remove the call"
        ) from error


def _called(what: str, function: Callable[[], Any]) -> Any:
    """Call a function of a user's environment, and return its result. An error whose own words say what to do, such as
    that of a missing package, is raised unchanged. Of an invalid specification, the class with the fault is named.

    Raises:
        UnknownEnvironment: the function raised another error; ``what`` are the first words of the message.
    """
    try:
        return function()
    except (OriginalError, ImportError):
        raise
    except ValidationError as error:
        fault = first_fault(error, of=getattr(surrogym_shared.spec, error.title, None))
        raise UnknownEnvironment(f"{what}: {error.title}: {fault}; correct it and try again") from error
    except Exception as error:
        raise UnknownEnvironment(f"{what}: {sentence(error)}; correct it and try again") from error


def _own(name: str, made: Any, spec: EnvironmentSpec | None, choose: Choose) -> Environment:
    if not callable(getattr(made, "spec", None)):
        return answering(made)  # raises an error that names the missing method
    own = _called(f"spec() of {name} failed", made.spec)
    given = choose(spec or own)
    require_period(name, given, period_of(made))
    return answering(made if given == own else Respecified(made, given))
