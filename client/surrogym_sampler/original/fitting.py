"""Checks of whether a policy that was trained for one specification may act in an environment with another one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

from surrogym_sampler.original.errors import PolicyMisfit
from surrogym_sampler.original.executables import is_executable
from surrogym_sampler.original.periods import is_other
from surrogym_shared.spec import BoxAction, EnvironmentSpec

ROUNDING = 1e-6  # an end of a range may be exceeded by this share of the end, because float32 rounds

Range: TypeAlias = tuple[float, float]


def check_shape(trained: EnvironmentSpec, own: EnvironmentSpec, called: str) -> None:
    """Check that a specification has the coordinates and the kind of action that a policy was trained for.

    Args:
        trained: the specification that the policy was trained for.
        own: the other specification.
        called: the owner of the other specification in messages, such as "the environment".

    Raises:
        PolicyMisfit: the coordinates or the actions differ.
    """
    expected, got = shape_in_words(trained), shape_in_words(own)
    if expected != got:
        raise PolicyMisfit(f"{_misfit(trained, called)}: expected {expected}, got {got}{advice_on_lags(trained, own)}")


def check_policy(trained: EnvironmentSpec, own: EnvironmentSpec) -> None:
    """Check that an environment has what a policy was trained for: coordinates, action, observation, sampling
    period and, if the policy was trained with limits, the same limits.

    Limits of continuous actions must lie within the environment's, because actions beyond them would be clipped. Bins
    must be equal, because a policy outputs their numbers. Access, ranges and starts may differ.

    Args:
        trained: the specification that the policy was trained for.
        own: the specification of the environment.

    Raises:
        PolicyMisfit: the environment does not fit.
    """
    misfit = _misfit(trained, "the environment")
    check_shape(trained, own, "the environment")
    asked, allowed = trained.action.ranges, own.action.ranges
    both = zip(asked, allowed, strict=True)
    if not all(is_within(a, b) and (_bins(own) is None or is_within(b, a)) for a, b in both):
        raise PolicyMisfit(f"{misfit}: expected actions from {range_in_words(asked)}, got {range_in_words(allowed)}")
    if is_other(trained.sampling_period, own.sampling_period):
        raise PolicyMisfit(
            f"{misfit}: expected a step every {trained.sampling_period:g} s (sampling_period), got "
            f"{own.sampling_period:g} s"
        )
    if trained.limits is not None and trained.limits != own.limits:
        raise PolicyMisfit(
            f"{misfit}: expected the limits that the policy was trained with, got {'other' if own.limits else 'no'} "
            "limits: declare them in the environment's specification, or give a specification that has them with "
            "--spec FILE"
        )
    expected, got = _observation_in_words(trained), _observation_in_words(own)
    if len(trained.observation) != len(own.observation):
        raise PolicyMisfit(f"{misfit}: expected observation ({expected}), got ({got})")
    for a, b in zip(trained.observation, own.observation, strict=True):
        if a.term != b.term:
            raise PolicyMisfit(
                f"{misfit}: expected observation ({expected}), got ({got}), in which {b.name!r} is another "
                f"term than {a.name!r}"
            )


def is_within(asked: Range, allowed: Range) -> bool:
    """Return whether one range lies in another, apart from rounding. A range with NaN lies in none."""
    slack = ROUNDING * max(map(abs, allowed))
    return allowed[0] - slack <= asked[0] and asked[1] <= allowed[1] + slack


def range_in_words(ranges: Sequence[Range]) -> str:
    """Return the limits of several entries in words, such as "[0, -2] to [1, 2]"."""
    low, high = (", ".join(f"{bound:g}" for bound in bounds) for bounds in zip(*ranges, strict=True))
    return f"[{low}] to [{high}]"


def shape_in_words(spec: EnvironmentSpec) -> str:
    """Return coordinates and action in words, such as "coordinates (x, v) and a box action of 1"."""
    bins = _bins(spec)
    of = "" if bins is None else f" in {', '.join(map(str, bins))} bins"
    return f"coordinates ({', '.join(spec.coordinate_names)}) and a {spec.action.kind} action of {spec.action.size}{of}"


def advice_on_lags(expected: EnvironmentSpec, own: EnvironmentSpec) -> str:
    """Return the advice to give the specification that declares the lags, if ``own`` is the expected one without them;
    otherwise ""."""
    read = tuple(c.name for c in expected.coordinates if c.lag is None)
    if read == expected.coordinate_names or read != own.coordinate_names:
        return ""
    return "; give the specification that declares the lags with --spec FILE"


def meant_in_words(spec: EnvironmentSpec) -> str:
    """Return in words which environment a policy is for. The command of a program is left out, because a stranger may
    have written it."""
    name = "a program" if is_executable(spec.environment) else spec.environment or "an environment"
    return f"{name} with {shape_in_words(spec)}"


def _misfit(trained: EnvironmentSpec, called: str) -> str:
    name = trained.environment
    meant = "" if not name or is_executable(name) else f", it is for {name}"
    return f"the policy does not fit {called}{meant}"


def _observation_in_words(spec: EnvironmentSpec) -> str:
    return ", ".join(entry.name for entry in spec.observation)


def _bins(spec: EnvironmentSpec) -> tuple[int, ...] | None:
    return spec.action.bins if isinstance(spec.action, BoxAction) else None
