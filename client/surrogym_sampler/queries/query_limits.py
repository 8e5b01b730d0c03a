"""Checks of the server's queries against the original environment's own specification."""

from __future__ import annotations

from collections.abc import Sequence

from surrogym_sampler.original.errors import QueryRefused, UnknownEnvironment
from surrogym_sampler.original.fitting import Range, advice_on_lags, is_within, range_in_words
from surrogym_sampler.original.periods import is_other
from surrogym_shared.spec import MAX_ROLLOUT_QUERY, Access, BoxAction, EnvironmentSpec
from surrogym_shared.spec import limits as sampled
from surrogym_shared.wire import Query, StepQuery

IN_WORDS: dict[Access, str] = {"any": "any state", "snapshot": "snapshots", "reset": "resets alone"}


def check_environment(surrogate: str, asked: EnvironmentSpec, own: EnvironmentSpec) -> None:
    """Check that an environment fits a surrogate: it has the same coordinates, action and start of a query (any state,
    snapshot or reset), and its ranges include those of the surrogate.

    Args:
        surrogate: name of the surrogate, for messages.
        asked: the surrogate's specification.
        own: the environment's specification.

    Raises:
        UnknownEnvironment: the environment does not fit.
    """
    expected, got = _shape(asked), _shape(own)
    if expected != got:
        advice = advice_on_lags(asked, own) or "; register the environment under another name"
        raise UnknownEnvironment(
            f"the environment does not fit surrogate {surrogate!r}: expected {expected}, got {got}{advice}"
        )
    if is_other(asked.sampling_period, own.sampling_period):
        raise UnknownEnvironment(
            f"the environment does not fit surrogate {surrogate!r}: expected a step every {asked.sampling_period:g} s "
            f"(sampling_period), got {own.sampling_period:g} s; register the environment under another name"
        )
    if asked.limits is not None and asked.limits != own.limits:
        raise UnknownEnvironment(
            f"the environment does not fit surrogate {surrogate!r}: expected a specification with the surrogate's "
            "limits, which the sampler keeps at the machine, got other limits or none; declare them in the "
            "environment's specification, or give a specification that has them with --spec FILE"
        )
    _check_ranges("actions", asked.action.ranges, own.action.ranges)
    _check_ranges("coordinates", [sampled(c.sampling) for c in asked.coordinates], _coordinate_ranges(own))


def check_query(own: EnvironmentSpec, query: Query) -> None:
    """Check a query against the environment's own specification, before its first step.

    A coordinate may be anywhere within its bounds or, on a side without a bound, within its sampling range.

    Raises:
        QueryRefused: the environment does not allow the query.
    """
    if query.kind != own.query:
        raise QueryRefused(
            f"expected a {own.query} query, as the environment's specification declares, got a {query.kind} query: "
            "register the environment under another name"
        )
    if isinstance(query, StepQuery):
        names = [f"coordinate {name!r}" for name in own.coordinate_names]
        _check_values("coordinates", names, query.coordinates, _coordinate_ranges(own))
        check_action(own, query.action)
        return
    if query.snapshot is not None and not own.snapshots:
        raise QueryRefused(
            "expected a query that begins at a reset, as the environment has no snapshots, got a query that begins at "
            "a snapshot: register the environment under another name"
        )
    longest = own.max_rollout or own.time_limit or MAX_ROLLOUT_QUERY
    if not 1 <= len(query.actions) <= longest:
        raise QueryRefused(
            f"expected a query of 1 to {longest} actions, got {len(query.actions)}: register the "
            f"environment under another name with --max-rollout {longest}"
        )
    for action in query.actions:
        check_action(own, action)


def check_action(own: EnvironmentSpec, action: Sequence[float]) -> None:
    """Raise ``QueryRefused`` if the environment's own specification does not allow an action (F,)."""
    _check_values("action", [f"action {i}" for i in range(own.action.size)], action, own.action.ranges)
    if not isinstance(own.action, BoxAction) and not all(float(value).is_integer() for value in action):
        raise QueryRefused(
            f"expected whole numbers for the query's discrete actions, got {list(action)}: register the environment "
            "under another name"
        )


def _check_values(what: str, names: Sequence[str], values: Sequence[float], ranges: Sequence[Range]) -> None:
    if len(values) != len(ranges):
        raise QueryRefused(
            f"{what} of the query: expected {len(ranges)} numbers, as the environment has, got {len(values)}: register "
            "the environment under another name"
        )
    for name, value, allowed in zip(names, values, ranges, strict=True):
        if not is_within((value, value), allowed):
            raise QueryRefused(
                f"{name} of the query: expected a value in the environment's range [{allowed[0]:g}, {allowed[1]:g}], "
                f"got {value:g}: register the environment under another name"
            )


def _check_ranges(what: str, asked: Sequence[Range], own: Sequence[Range]) -> None:
    if not all(map(is_within, asked, own)):
        raise UnknownEnvironment(
            f"the surrogate's {what} are not the environment's: expected {what} from {range_in_words(own)}, "
            f"got {range_in_words(asked)}; register it under another name"
        )


def _coordinate_ranges(spec: EnvironmentSpec) -> list[Range]:
    return [coordinate.settable for coordinate in spec.coordinates]


def _shape(spec: EnvironmentSpec) -> str:
    names = ", ".join(spec.coordinate_names)
    access = IN_WORDS[spec.access]
    return f"coordinates ({names}), a {spec.action.kind} action of {spec.action.size}, and access to {access}"
