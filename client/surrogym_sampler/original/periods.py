"""The sampling period of an environment: the seconds from one step to the next."""

from __future__ import annotations

from math import isclose

from surrogym_sampler.original.errors import UnknownEnvironment
from surrogym_sampler.original.protocol import runs_in_parallel
from surrogym_shared.spec import EnvironmentSpec

NAMES = ("sampling_period", "dt")  # names of attributes, and of entries of `metadata`, that give the sampling period
CLOSE = 1e-3  # sampling periods with at most this relative difference count as equal


def period_of(environment: object) -> float | None:
    """Return the period in seconds from an environment's attributes or ``metadata``, such as MuJoCo's ``dt``; None if
    it has none."""
    metadata = getattr(environment, "metadata", None)
    noted = metadata if isinstance(metadata, dict) else {}
    found = [value for name in NAMES for value in (getattr(environment, name, None), noted.get(name))]
    numbers = (float(value) for value in found if isinstance(value, int | float) and not isinstance(value, bool))
    return next((number for number in numbers if number > 0), None)


def is_timed(environment: object, spec: EnvironmentSpec) -> bool:
    """Return whether the seconds between the steps of an environment are measured, to be compared with the declared
    sampling period: it can only be reset, and is no simulator of which several instances may be open at once."""
    return spec.sampling_period is not None and spec.access == "reset" and not runs_in_parallel(environment)


def is_other(one: float | None, other: float | None) -> bool:
    """Return whether two periods are both known and differ by more than rounding."""
    return one is not None and other is not None and not isclose(one, other, rel_tol=CLOSE)


def require_period(name: str, spec: EnvironmentSpec, own: float | None) -> None:
    """Check that an environment's own period equals the one that its specification declares, if both are known.

    Raises:
        UnknownEnvironment: the periods differ.
    """
    if is_other(own, spec.sampling_period):
        raise UnknownEnvironment(
            f"expected {name} to take a step every {spec.sampling_period:g} s, the sampling_period of its "
            f"specification, got {own:g} s: correct one of them"
        )
