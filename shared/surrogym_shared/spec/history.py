"""Add lags (coordinates that repeat the past) to a specification, for an environment whose observation does not
determine the next state."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from surrogym_shared.checks import require, require_known
from surrogym_shared.spec.actions import Action, BoxAction
from surrogym_shared.spec.coordinates import Bounds, Coordinate, Fixed, Lag, StartDistribution, Uniform
from surrogym_shared.spec.environment import EnvironmentSpec
from surrogym_shared.spec.terms import ObservationEntry

COUNTER = "steps since reset"


def with_history(
    spec: EnvironmentSpec,
    *,
    changes: int = 0,
    actions: int = 0,
    largest: Mapping[str, float] | None = None,
    at_start: Mapping[str, float] | None = None,
    rate: Sequence[float | None] | None = None,
) -> EnvironmentSpec:
    """Add lags (past actions, and past changes of coordinates) to the coordinates and to the observation.

    Args:
        spec: specification whose coordinates can all be measured in the environment, with queries of kind ``rollout``.
        changes: number of earlier changes of each moving coordinate to add, such as 1 for a hidden speed.
        actions: number of earlier actions to add. An action that takes effect after a dead time of three steps needs
            three, and one more if the plant is sampled with a zero-order hold and itself reacts with a delay.
        largest: largest change of each moving coordinate in one step, in its unit; needed for ``changes``.
        at_start: largest change of a coordinate in the step before a reset, if the environment may move at a reset.
            This change is unknown, so a model does not learn from the first steps of each episode.
        rate: largest change of each entry of a continuous action per second, None for an entry without a limit; needs
            ``actions`` of 1 or more.

    Raises:
        ValueError: the environment can be set to states, or ``largest`` does not fit the moving coordinates.

    Examples:
        >>> with_history(spec, changes=1, actions=4, largest={"level": 0.3})
    """
    largest = dict(largest or {})
    moving = [c for c in spec.coordinates if c.moves]
    require(
        changes >= 0 and actions >= 0,
        f"history: expected 0 or more for changes and actions, got {changes} and {actions}",
    )
    require_known("history: largest", largest, [c.name for c in moving])
    at_start = dict(at_start or {}) if changes else {}
    require_known("history: at_start", at_start, largest)
    lacking = [c.name for c in moving if c.name not in largest] if changes else []
    require(
        not lacking, f"history: expected the largest change in one step of {lacking}, got none: add it to 'largest'"
    )
    lags = [lag for c in moving for lag in _of_changes(c, changes, largest.get(c.name, 0.0))]
    lags += [lag for entry in range(spec.action.size) for lag in _of_actions(spec, entry, actions)]
    starts: dict[str, StartDistribution] = {lag.name: Fixed(value=_at_rest(lag)) for lag in lags}
    for name, most in at_start.items():
        starts |= {f"{name}.change{age}": Uniform(low=-most, high=most) for age in range(1, changes + 1)}
    entries = tuple(ObservationEntry(name=lag.name, term=lag.term) for lag in lags)
    if at_start:
        lags.append(_counter(changes))
        starts[COUNTER] = Fixed(value=float(changes))
    own = {name: getattr(spec, name) for name in EnvironmentSpec.model_fields}
    return EnvironmentSpec(
        **own
        | {
            "coordinates": (*spec.coordinates, *lags),
            "observation": (*spec.observation, *entries),
            "start": {**spec.start, **starts},
            "starts": tuple((*start, *(_at_rest(lag) for lag in lags)) for start in spec.starts),
            "action": spec.action if rate is None else _limited(spec.action, rate),
        }
    )


def _limited(action: Action, rate: Sequence[float | None]) -> BoxAction:
    """Return a continuous action with a rate. Raises ``ValueError`` for a discrete one, whose numbers have no order."""
    require(isinstance(action, BoxAction), "history: expected a continuous action (BoxAction) for a rate, got discrete")
    return BoxAction(**{**dict(action), "rate": tuple(rate)})


def _of_changes(coordinate: Coordinate, count: int, largest: float) -> Iterable[Coordinate]:
    """Yield coordinates that repeat the last ``count`` changes of a coordinate, the latest change first."""
    name = coordinate.name
    for age in range(1, count + 1):
        lag = Lag(kind="change", of=name) if age == 1 else Lag(kind="value", of=f"{name}.change{age - 1}")
        yield Coordinate(
            name=f"{name}.change{age}", sampling=Uniform(low=-largest, high=largest), unit=coordinate.unit, lag=lag
        )


def _of_actions(spec: EnvironmentSpec, entry: int, count: int) -> Iterable[Coordinate]:
    """Yield coordinates that repeat the last ``count`` values of an entry of the action, the latest value first."""
    low, high = spec.action.ranges[entry]
    for age in range(1, count + 1):
        name = f"action{entry}.lag"
        lag = Lag(kind="action", entry=entry) if age == 1 else Lag(kind="value", of=f"{name}{age - 1}")
        yield Coordinate(name=f"{name}{age}", sampling=Uniform(low=low, high=high), lag=lag)


def _counter(steps: int) -> Coordinate:
    """Return the coordinate that counts the steps since the reset, up to ``steps``."""
    bounds = Bounds(low=0.0, high=float(steps))
    return Coordinate(name=COUNTER, sampling=Uniform(low=0.0, high=float(steps)), bounds=bounds, lag=Lag(kind="steps"))


def _at_rest(lag: Coordinate) -> float:
    """Return the value of a lag at the start of an episode: 0 for a change, the action closest to 0 for an action."""
    if lag.name == COUNTER:
        return lag.settable[1]
    low, high = lag.settable
    return min(max(0.0, low), high)
