"""Checks of an installation, a server and an original environment before first use: one finding for each
checked thing."""

from __future__ import annotations

import platform
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points, version
from importlib.util import find_spec
from typing import Any

import numpy as np

from surrogym_client.errors import (
    ProblemError,
    ProtocolMismatch,
    Refused,
    ServerUnreachable,
    SurrogymClientError,
    Unauthenticated,
)
from surrogym_client.runtime.versions import EXTRAS, versions
from surrogym_client.transport.api import Api
from surrogym_sampler.diagnosis.access import EXACT, Access, CheckFailed, examine
from surrogym_sampler.diagnosis.taking import take
from surrogym_sampler.original.actions import middle_action
from surrogym_sampler.original.episodes import draw
from surrogym_sampler.original.errors import OriginalError, StepFailed
from surrogym_sampler.original.executables import Executable
from surrogym_sampler.original.isolated import IsolatedEnvironment
from surrogym_sampler.original.protocol import Array, OriginalEnvironment, RealStep
from surrogym_sampler.original.simulator import Simulated
from surrogym_sampler.queries.sample_conversion import sample_of
from surrogym_shared.dirt import Dirt, identify, sensors
from surrogym_shared.dirt.words import declared, history_call, traits
from surrogym_shared.plugins import Registry
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import PROTOCOL, StepQuery
from surrogym_shared.words import counted

ROUND_TRIPS = 20
# If changes are predicted with an error above this share of their standard deviation, and noise does not explain it,
# the rollouts can't tell which history is needed.
EXPLAINED = 0.5
NEEDS = "see docs/how-to/own-environment.md for what an environment needs"
# The registry that each group of plug-ins (entry points) extends, as module:name. A registry is imported only if the
# package that contains it is installed.
REGISTRIES = {
    "surrogym.policy_searches": "surrogym_trainer.training.search:SEARCHES",
    "surrogym.acquisitions": "surrogym_server.sampling.acquisition:ACQUISITIONS",
    "surrogym.models": "surrogym_server.models.registry:MODELS",
}


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes:
        name: name of the check.
        said: the result in words.
        way_out: what to do about a problem; None if there is no problem.
        notable: whether to show the result to a person although it is no problem.
    """

    name: str
    said: str
    way_out: str | None = None
    notable: bool = False


def installation() -> Iterator[Finding]:
    """Report the Python version, the installed packages, the extras that are missing, and broken plug-ins."""
    yield Finding("python", f"{platform.python_version()} on {platform.system()} {platform.machine()}")
    packages = ", ".join(f"{name} {number}" for name, number in versions().items() if name != "python")
    lacking = [extra for extra, modules in EXTRAS.items() if not all(find_spec(module) for module in modules)]
    without = f"; not installed: {', '.join(f'surrogym[{extra}]' for extra in lacking)}" if lacking else ""
    yield Finding("packages", packages + without)
    for registry in _registries():
        for name, why in registry.broken.items():
            said = f"the {registry.kind} {name!r} is left out: {why}"
            yield Finding("plug-in", said, "update the package, or uninstall it")


def _registries() -> Iterator[Registry[Any]]:
    """Yield the registries that installed plug-ins extend. The others are not imported, because some of them load
    torch."""
    for group, place in REGISTRIES.items():
        module, _, name = place.partition(":")
        if entry_points(group=group):
            # If the package of the registry is not installed, nothing uses its plug-ins, so the registry is skipped.
            with suppress(ImportError):
                yield getattr(import_module(module), name)


def service(api: Api) -> Iterator[Finding]:
    """Check whether the server answers, is ready, speaks this protocol and accepts this token, and measure a round
    trip.

    A check that depends on a failed one yields no finding.
    """
    try:
        health = api.health()
    except ProtocolMismatch as error:
        yield Finding("server", str(error), f"install a surrogym of protocol {PROTOCOL} on both sides")
        return
    except ServerUnreachable as error:
        yield Finding("server", str(error), ServerUnreachable.way_out)
        return
    ours = version("surrogym")
    same = "" if health.version == ours else f"; this client is {ours}"
    yield Finding("server", f"surrogym {health.version} at {api.url}, protocol {health.protocol}{same}")
    try:
        yield Finding("ready", f"storage {api.ready().storage}")
    except (ProblemError, ServerUnreachable) as error:
        yield Finding("ready", str(error), "the server's database does not answer: see the server's log")
    yield _access(api)
    yield _round_trip(api)


def environment(
    opened: Callable[[], IsolatedEnvironment | Executable | Simulated], history: int = 0
) -> Iterator[Finding]:
    """Check whether the original environment can be opened, can take a step, and can be set to a state.

    The checks take real steps, which are not counted towards the budget of any surrogate.

    Args:
        opened: opens the environment.
        history: number of further real steps, to find dead time, encoders, friction, noise, and how many earlier
            changes and actions the next change depends on; 0 takes none.
    """
    try:
        with closing(opened()) as original:
            spec = original.spec()
            names = ", ".join(spec.coordinate_names)
            yield Finding("environment", f"coordinates ({names}), {spec.action.kind} action, {spec.query} queries")
            step = _one_step(original, spec)
            yield step
            if step.way_out is None:
                yield from _access_of(original, spec)
                if history:
                    yield from _dirt_of(original, spec, history)
    except OriginalError as error:
        yield Finding("environment", str(error), NEEDS)


def _access_of(original: IsolatedEnvironment | Executable | Simulated, spec: EnvironmentSpec) -> Iterator[Finding]:
    """Report how exactly the environment can be set, reset and restored, and at which states its queries should
    begin."""
    try:
        access = examine(original, spec)
    except CheckFailed as error:
        said = f"{error}; this took {error.steps + 1} real steps"
        yield Finding("mode", said, "a sampler would fail in the same way: mend the environment first")
        return
    if access.set_error is not None:
        read, again = _error(access.set_error), _error(access.repeat_error)
        yield Finding("state", f"set and read back: {read}; two steps from one state: {again}")
    if access.reset_error is not None:
        yield _resets(access)
    if access.memory_error is not None:
        yield Finding("memory", f"a step of an episode, and from its state set anew: {_error(access.memory_error)}")
    if access.restore_error is not None:
        yield Finding(
            "snapshots", f"a step from a saved state, and after a return to it: {_error(access.restore_error)}"
        )
    taken = f"{access.mode}; this took {access.steps + 1} real steps and {access.resets + 1} resets at most"
    yield Finding("mode", taken, _way_out(spec, access))


def _resets(access: Access) -> Finding:
    """Report whether two resets with the same seed give the same start, and whether the same actions then give the same
    episode."""
    same, alike = _error(access.reset_error), _error(access.replay_error)
    if not access.ignores_seed:
        return Finding("resets", f"two with one seed: {same}; the same actions from there: {alike}")
    said = (
        f"the environment ignores its seed: two resets with one seed are {same}. Two controllers never run the same "
        "starts, so compare the means of many episodes; for the same starts, reset(seed=...) has to seed every random "
        "number"
    )
    return Finding("resets", said, notable=True)


def _dirt_of(
    original: IsolatedEnvironment | Executable | Simulated, spec: EnvironmentSpec, steps: int
) -> Iterator[Finding]:
    """Report dead time, encoders, friction that sticks and noise, and how many earlier changes and actions the next
    change depends on."""
    if spec.query != "rollout":
        yield Finding("history", "not looked for: an environment that is set to a state has no past")
        return
    try:
        rollouts = take(original, spec, steps)
    except StepFailed as error:
        yield Finding("history", str(error), "a sampler would fail in the same way: mend the environment first")
        return
    known = sensors(spec)
    found = identify(rollouts, known)
    took = f"this took {sum(len(rollout.action) for rollout in rollouts)} real steps"
    for name, said in traits(found, known, spec, rollouts):
        yield Finding(name, said, notable=True)
    yield _history_of(found, declared(spec), history_call(found, known, rollouts), took)


def _history_of(found: Dirt, has: tuple[int, int], call: str, took: str) -> Finding:
    """Report how many earlier changes and actions the next change depends on, and whether the specification already
    declares them as coordinates (lags).

    Args:
        found: what was found.
        has: number of earlier changes and of earlier actions that are declared.
        call: source text that declares those that were found.
        took: how many real steps were taken, in words.
    """
    if found.explained is None or found.plain is None:
        return Finding("history", f"episodes this short don't tell; {took}", "give --history more steps")
    error, changes = float(found.explained.error.max()), found.explained.changes
    if error > EXPLAINED and not found.noise:
        return Finding("history", f"a regression does not show how far one has to look back; {took}")
    if changes <= has[0] and found.actions <= has[1]:
        return Finding("history", f"what is declared tells what happens next; {took}")
    needed = (
        f"the next change of a coordinate depends on {counted(changes, 'earlier change')} and "
        f"{counted(found.actions, 'earlier action')}"
    )
    if changes:
        without = float(found.plain.error.max())
        needed += (
            f": errors of {100 * error:.2g} % of its standard deviation, and of {100 * without:.2g} % without them"
        )
    moving = ", with at_start if a reset leaves it moving" if changes else ""
    return Finding("history", f"{needed}; {took}", f"declare {call}{moving}; see docs/how-to/history.md")


def _way_out(spec: EnvironmentSpec, access: Access) -> str | None:
    """Return what to do if queries can't begin at the states that the specification declares (any state, or snapshots);
    None if they can."""
    if spec.access == "any" and not access.can_set:
        other = "snapshot" if access.can_restore else "reset"
        return f"register it with --access {other}; what it remembers must be a coordinate for more"
    if spec.access == "snapshot" and not access.can_restore:
        return "register it with --access reset, or let save and restore keep everything that it remembers"
    return None


def _error(share: float | None) -> str:
    """Return a difference in words; ``share`` is a share of the sampling range, None if nothing was compared."""
    if share is None:
        return "not compared"
    return "equal" if share <= EXACT else f"{100 * share:.2g} % of the range apart"


def _access(api: Api) -> Finding:
    try:
        access = api.access()
    except Refused as error:
        return Finding("token", str(error), Unauthenticated.way_out)
    except SurrogymClientError as error:
        return Finding("token", str(error), "bring server and client to the same version")
    return Finding("token", f"role {access.role}" if access.tokens else "none needed: everybody is admin here")


def _round_trip(api: Api) -> Finding:
    try:
        seconds = sorted(_timed(api) for _ in range(ROUND_TRIPS))
    except SurrogymClientError as error:
        return Finding("round trip", str(error), ServerUnreachable.way_out)
    median, worst = 1_000 * statistics.median(seconds), 1_000 * seconds[-1]
    return Finding("round trip", f"median {median:.2g} ms, longest {worst:.2g} ms of {ROUND_TRIPS}")


def _timed(api: Api) -> float:
    started = time.perf_counter()
    api.health()
    return time.perf_counter() - started


def _one_step(original: IsolatedEnvironment | Executable | Simulated, spec: EnvironmentSpec) -> Finding:
    """Report one real step: from a random state of the sampling range, or from a reset if the state can't be set."""
    start, action = draw(spec, np.random.default_rng(0), wide=True), middle_action(spec)
    begun = time.perf_counter()
    try:
        if spec.query == "rollout":
            start = original.begin(0)
            step = original.act(action)
        else:
            assert isinstance(original, OriginalEnvironment)
            step = original.step_from(start, action)
        seconds = time.perf_counter() - begun
        _check(step, start, action)
    except StepFailed as error:
        return Finding("step", str(error), "a sampler would fail in the same way: mend the environment first")
    return Finding("step", f"one real step in {1_000 * seconds:.2g} ms, reward {float(step.reward):.4g}")


def _check(step: RealStep, start: Array, action: Array) -> None:
    """Raise ``StepFailed`` if a sampler could not submit this step from ``start`` with ``action`` as a sample."""
    query = StepQuery(
        id=1,
        number=0,
        purpose="manual",
        attempt=1,
        lease_token="none",
        lease_seconds=1.0,
        coordinates=start.tolist(),
        action=action.tolist(),
    )
    sample_of(query, step, len(start))
