"""Checks of a JSON file with parameters for ``pcgym.make_env``, because pc-gym itself checks nothing."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from surrogym_sampler.original.errors import UnknownEnvironment
from surrogym_sampler.original.protocol import is_number

FEWEST, MOST = 2, 100_000  # smallest and largest number N of samples in an episode that a file may declare
NEEDED = ("model", "N", "tsim", "SP", "a_space", "o_space", "x0")
RANGES = ("a_space", "o_space", "disturbance_bounds")
SHOWN = 60  # largest number of characters of a value in a message


def read_parameters(path: Path) -> dict[str, Any]:
    """Read the parameters in a JSON file, and make all checks that don't need the model.

    Raises:
        UnknownEnvironment: the file is not a JSON object, or one of its values can't be used.
    """
    try:
        given = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise UnknownEnvironment(f"{path} is not JSON: {error}; correct the file at this position") from error
    if not isinstance(given, dict) or (lacking := [key for key in NEEDED if key not in given]):
        lacks = f"; it lacks {', '.join(lacking)}" if isinstance(given, dict) else ""
        raise UnknownEnvironment(f"{path}: expected an object with {', '.join(NEEDED)}{lacks}")
    _check_times(path, given)
    for key in RANGES:
        if key in given:
            _check_range(path, key, given[key])
    if not _numbers(given["x0"]):
        raise _expected(path, "expected the parameter x0 to be a list of finite numbers", given["x0"])
    _check_schedule(path, "SP", given["SP"], given["N"])
    if given.get("disturbances") is not None:
        _check_schedule(path, "disturbances", given["disturbances"], given["N"])
        if "disturbance_bounds" not in given:
            raise UnknownEnvironment(
                f"{path} has disturbances but no disturbance_bounds: add disturbance_bounds with low and high"
            )
        count = len(given["disturbances"])
        _check_length(path, "low and high of disturbance_bounds", given["disturbance_bounds"]["low"], count, "")
    return given


def check_model(where: str, given: Mapping[str, Any], info: Mapping[str, Any]) -> None:
    """Check parameters against the model's own description.

    Args:
        where: the file, for messages.
        given: the checked parameters.
        info: description of the model by pc-gym, with names of its states, inputs and disturbances.

    Raises:
        UnknownEnvironment: the parameters name unknown states or disturbances, or a list has the wrong number of
            values.
    """
    states, inputs = list(info["states"]), list(info["inputs"])
    for key, known in (("SP", states), ("disturbances", list(info["disturbances"] or ()))):
        if unknown := [name for name in given.get(key) or () if name not in known]:
            raise UnknownEnvironment(
                f"{where}: expected names of {key} among {', '.join(known)}, got {', '.join(unknown)}: correct the "
                "parameters"
            )
    setpoints = list(given["SP"])
    shown = f" (states {', '.join(states)}, then setpoints of {', '.join(setpoints)})"
    for key, values in (("low and high of o_space", given["o_space"]["low"]), ("x0", given["x0"])):
        _check_length(where, key, values, len(states) + len(setpoints), shown)
    _check_length(where, "low and high of a_space", given["a_space"]["low"], len(inputs), f" ({', '.join(inputs)})")


def _check_times(path: Path, given: Mapping[str, Any]) -> None:
    if not isinstance(given["model"], str):
        raise _expected(path, "expected the parameter model to be the name of a model, such as cstr", given["model"])
    count = given["N"]
    if not isinstance(count, int) or isinstance(count, bool) or not FEWEST <= count <= MOST:
        raise _expected(path, f"expected the parameter N to be a whole number from {FEWEST} to {MOST:,}", count)
    if not is_number(given["tsim"]) or given["tsim"] <= 0:
        raise _expected(path, "expected the parameter tsim to be a positive number", given["tsim"])


def _check_range(path: Path, key: str, given: Any) -> None:
    low, high = (given.get("low"), given.get("high")) if isinstance(given, dict) else (None, None)
    if low is None or high is None or not _numbers(low) or not _numbers(high) or len(low) != len(high):
        raise _expected(
            path,
            f"expected {key} to be an object with low and high, two lists of finite numbers of the same length",
            given,
        )
    if not all(a < b for a, b in zip(low, high, strict=True)):
        raise _expected(path, f"expected low of {key} to be below the corresponding high value", given)


def _check_schedule(path: Path, key: str, given: Any, count: int) -> None:
    if not isinstance(given, dict) or not given:
        raise _expected(
            path,
            f'expected {key} to be an object that gives at least one name a list of numbers, such as {{"T": [1, 2]}}',
            given,
        )
    for name, values in given.items():
        if not _numbers(values):
            raise _expected(path, f"expected {key} of {name} to be a list of finite numbers", values)
        if len(values) < count:
            raise UnknownEnvironment(
                f"{path}: expected {key} of {name} to have a value for each of the N = {count} samples, "
                f"got {len(values)}: add the missing values"
            )


def _check_length(where: str | Path, key: str, values: Sequence[float], count: int, shown: str) -> None:
    if len(values) != count:
        raise UnknownEnvironment(
            f"{where}: expected {key} to have {count} value{'s' * (count != 1)}{shown}, got {len(values)}"
        )


def _numbers(given: Any) -> bool:
    return isinstance(given, list) and bool(given) and all(map(is_number, given))


def _expected(path: Path, expected: str, got: Any) -> UnknownEnvironment:
    text = json.dumps(got)
    shown = text if len(text) <= SHOWN else f"{text[:SHOWN]}..."
    return UnknownEnvironment(f"{path}: {expected}, got {shown}; correct the file")
