"""The settings of a person for an FMU: none for ``fmu:PLANT.fmu``, those in the JSON file for ``fmu:PLANT.json``.

Only ``read_choices`` reads a file; the other functions are pure. Times are in seconds.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from surrogym_sampler.original.errors import UnknownEnvironment
from surrogym_sampler.original.fmus.archive import Archive, Declared
from surrogym_shared.checks import Number
from surrogym_shared.faults import first_fault

PREFIX = "fmu:"
Value = bool | int | float | str


class Choices(BaseModel):
    """The settings of a person for an FMU, as in a JSON file. None leaves a setting to the model description.

    Attributes:
        fmu: path of the FMU, from the folder of the JSON file.
        step: seconds of one action.
        actions: names of the inputs that a policy sets, or low and high of each by its name.
        coordinates: names of the variables that describe the state.
        start: values of parameters and other variables before the FMU is initialised, by name.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    fmu: str
    step: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    actions: dict[str, tuple[Number, Number]] | tuple[str, ...] | None = None
    coordinates: tuple[str, ...] | None = None
    start: dict[str, Value] = Field(default_factory=dict)

    @property
    def limits(self) -> Mapping[str, tuple[float, float]]:
        """Low and high of inputs, by name."""
        return self.actions if isinstance(self.actions, dict) else {}


def read_choices(name: str) -> tuple[Path, Choices]:
    """Return the path of the FMU that a name stands for, and the settings in its JSON file.

    Raises:
        UnknownEnvironment: the name is neither that of an FMU nor that of a JSON file, or the JSON file can't be used.
    """
    path = Path(name.removeprefix(PREFIX))
    if path.suffix == ".fmu":
        return path, Choices(fmu=path.name)
    if path.suffix != ".json" or not path.is_file():
        raise UnknownEnvironment(f"expected fmu:PLANT.fmu, or fmu:PLANT.json that names an FMU, got {name!r}")
    try:
        given = Choices.model_validate(json.loads(path.read_text(encoding="utf-8")))
    except ValidationError as error:
        wrong = first_fault(error) if error.errors()[0]["loc"] else "not a JSON object"
        raise UnknownEnvironment(
            f"{path}: {wrong}; expected the key fmu, and optionally step, actions, coordinates and start"
        ) from error
    except ValueError as error:
        raise UnknownEnvironment(f"{path} is not JSON: {error}; correct the file at this position") from error
    _check(path, given)
    return path.parent / given.fmu, given


def _check(path: Path, given: Choices) -> None:
    for action, (low, high) in given.limits.items():
        if not low < high:
            raise UnknownEnvironment(
                f"{path}: action {action!r}: expected low < high, got [{low:g}, {high:g}]: swap or correct them"
            )
    for key, names in (("actions", tuple(given.actions or ())), ("coordinates", given.coordinates)):
        if names and (twice := next((name for name in names if names.count(name) > 1), None)) is not None:
            raise UnknownEnvironment(
                f"{path}: {key}: expected each variable once, got {twice!r} twice: remove one of them"
            )


def driven(archive: Archive, choices: Choices) -> tuple[Declared, ...]:
    """Return the inputs that an action sets: those that a person chose, or else all real inputs.

    Raises:
        UnknownEnvironment: there are none, or a chosen variable is not a real input.
    """
    inputs = archive.of_causality("input")
    if choices.actions is None:
        if not inputs:
            kinds = sorted({v.type for v in archive.variables if v.causality == "input"})
            what = f"inputs of type {', '.join(kinds)} only" if kinds else "no scalar input"
            raise UnknownEnvironment(
                f"expected a continuous scalar input in {archive.path} for the action, got {what}: declare an "
                "input in the model, and export the FMU anew"
            )
        return inputs
    chosen = tuple(archive.named(name) for name in choices.actions)
    if not chosen or (wrong := [v.name for v in chosen if v not in inputs]):
        raise UnknownEnvironment(
            f"actions: expected one or more of the continuous inputs of {archive.path} ({_listed(inputs)}), got "
            f"{', '.join(wrong) if chosen else 'none'}: correct the JSON file"
        )
    return chosen


def described_by(archive: Archive, choices: Choices) -> tuple[Declared, ...]:
    """Return the variables whose values are the state: the first of these groups that exists.

    - The variables that a person chose.
    - The continuous states, if all of them can be set.
    - The outputs and internal variables that can be set, if the FMU declares no continuous states.
    - All outputs.
    - All continuous states.

    A variable with two names counts once.

    Raises:
        UnknownEnvironment: there are none, or a chosen variable is not a real number.
    """
    if choices.coordinates is not None:
        chosen = tuple(archive.named(name) for name in choices.coordinates)
        if not chosen or (wrong := [v.name for v in chosen if not v.is_real]):
            raise UnknownEnvironment(
                f"coordinates: expected continuous variables of {archive.path}, got "
                f"{_names(wrong) if chosen else 'none'}: correct the JSON file"
            )
        return chosen
    outputs = archive.of_causality("output")
    states = tuple(archive.named(name) for name in archive.states)
    held = tuple(v for v in (*outputs, *archive.of_causality("local")) if _can_be_set(v))
    for candidates, enough in ((states, all(map(_can_be_set, states))), (held, not states), (outputs, True)):
        if candidates and enough:
            return _once(candidates)
    if not states:
        raise UnknownEnvironment(
            f"expected a continuous scalar output in {archive.path} for the state, got none: declare one in the model "
            "and export it anew, or choose coordinates in a JSON file"
        )
    return _once(states)


def _can_be_set(variable: Declared) -> bool:
    return variable.variability == "continuous" and variable.can_start


def _once(variables: tuple[Declared, ...]) -> tuple[Declared, ...]:
    first: dict[int, Declared] = {}
    for variable in variables:
        first.setdefault(variable.reference, variable)
    return tuple(first.values())


def start_values(archive: Archive, choices: Choices) -> list[tuple[str, int, Value]]:
    """Return type, reference and value of each variable that a person sets before the FMU is initialised.

    Raises:
        UnknownEnvironment: a variable can't be set then, or has another type.
    """
    found = []
    for name, value in choices.start.items():
        variable = archive.named(name)
        if not variable.can_start:
            raise UnknownEnvironment(
                f"start: expected a parameter, an input or a variable with a start value, got {name!r} of "
                f"{archive.path}, which the FMU calculates: remove it"
            )
        found.append((variable.type, variable.reference, _of_type(variable, value)))
    return found


def _of_type(variable: Declared, value: Value) -> Value:
    if variable.is_real:
        wanted, fits = "a finite number", isinstance(value, int | float) and not isinstance(value, bool)
        fits = fits and math.isfinite(float(value))
    elif variable.type == "Boolean":
        wanted, fits = "true or false", isinstance(value, bool)
    elif variable.type == "String":
        wanted, fits = "a text", isinstance(value, str)
    else:
        wanted, fits = "a whole number", isinstance(value, int) and not isinstance(value, bool)
    if not fits:
        raise UnknownEnvironment(
            f"start: expected {wanted} for {variable.name!r} of type {variable.type}, got {value!r}: correct the value"
        )
    return float(value) if variable.is_real else value


def step_of(archive: Archive, choices: Choices) -> float:
    """Return the seconds of one action: those that a person chose, or else those of the FMU's default experiment.

    Raises:
        UnknownEnvironment: neither a person nor the FMU gives them.
    """
    step = choices.step or archive.step
    if not step or step <= 0:
        raise UnknownEnvironment(
            f"{archive.path} declares no stepSize in its default experiment: expected the seconds of one action, as "
            '{"fmu": "' + archive.path.name + '", "step": 0.1} in a file PLANT.json, and the name fmu:PLANT.json'
        )
    return step


def _names(names: list[str]) -> str:
    return ", ".join(names)


def _listed(variables: tuple[Declared, ...]) -> str:
    return _names([v.name for v in variables]) or "of which there are none"
