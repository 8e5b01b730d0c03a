"""Export of a surrogate as an FMU (functional mock-up unit, FMI 3.0), with the uncertainty of each step.

The FMU steps like a session in the variant ``deterministic``, to the mean next state. Further outputs are the standard
deviations of the model's predictions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from importlib.resources import files
from pathlib import Path

import torch

from surrogym_server.convert import stored_definition
from surrogym_server.engine.requests import limits_rewards
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.distributions import quantile
from surrogym_server.errors import InvalidInput
from surrogym_server.models.abilities import StepSource, WrittenInC, offers
from surrogym_server.models.files import from_bytes
from surrogym_server.models.port import DynamicsModel
from surrogym_server.virtual import reward_limits
from surrogym_shared.fmu import Block, Causality, Names, Variable, WrittenFmu, write_fmu
from surrogym_shared.spec import Coordinate
from surrogym_shared.surrogate_file import SurrogateFile

MOST_NUMBERS = 4_000_000  # models with more numbers are refused: C code of this size takes a minute and 1 GB to compile
ANYWHERE = (-math.inf, math.inf)


def write_twin(data: bytes, out: Path, period: float | None = None) -> WrittenFmu:
    """Convert a file of ``surrogym export`` to an FMU, and write it.

    Args:
        data: content of the file of ``surrogym export``.
        out: path of the FMU to write.
        period: duration of one step in seconds; None for the sampling period of the specification.

    Raises:
        NotASurrogateFile: ``data`` is not the content of such a file.
        InvalidInput: the model can't be written in C, the action has a rate, or the period is missing or not above 0.
        CannotCompile: the C compiler of this machine refused the sources.
        OSError: the FMU can't be written.
    """
    return write_fmu(twin_of(SurrogateFile.from_bytes(data), period), out)


def twin_of(file: SurrogateFile, period: float | None = None) -> Block:
    """Return the description of a surrogate's FMU: its variables and its C source.

    ``period`` is the duration of one step in seconds; None for the sampling period of the specification.

    Raises:
        InvalidInput: the model can't be written in C, the action has a rate, or the period is missing or not above 0.
    """
    definition = stored_definition(file.spec)
    if definition.rates:
        raise InvalidInput(
            "expected an action without rate (largest change per step), because an FMU does not keep rates, got one "
            "with rate: register the surrogate without rate, and limit the change of the input outside of the FMU"
        )
    model = from_bytes(definition, file.model)
    seconds = _period(file.spec.sampling_period if period is None else period)
    source = _source_of(model)
    limits = ANYWHERE
    if limits_rewards(definition) and 0 < model.samples <= len(file.samples):
        limits = reward_limits(float(file.samples.reward.min()), float(file.samples.reward.max()))
    own = {"twin.c": (files(__package__) / "twin.c").read_text(encoding="utf-8")}
    own["twin.h"] = "\n".join(_header(definition, model, limits))
    return Block(
        name=file.name,
        description=f"Surrogate {file.name}: {model.samples} real steps, model {model.digest[:16]}",
        variables=tuple(_variables(definition)),
        period=seconds,
        stop=None if definition.time_limit is None else definition.time_limit * seconds,
        sources={**source.files, **own},
    )


def _period(seconds: float | None) -> float:
    if seconds is None:
        raise InvalidInput(
            "expected the duration of a step, got neither --period nor a sampling_period in the specification: give "
            "--period, in seconds"
        )
    if not 0 < seconds < math.inf:
        raise InvalidInput(f"period: expected the duration of one step in seconds, above 0, got {seconds}")
    return seconds


def _source_of(model: DynamicsModel) -> StepSource:
    family = model.definition.learning.model.name
    able = offers(model, WrittenInC)
    if able is None:
        raise InvalidInput(
            f"model: expected a family that can be written in C, gaussian_process or sparse_gaussian_process, got "
            f"{family!r}"
        )
    source = able.step_source()
    if source is None:
        raise InvalidInput(
            "expected a model without a prior, and the package numba, which writes it in C, got a prior or no numba: "
            "remove the prior (surrogym prior NAME --drop), or install numba"
        )
    if source.numbers > MOST_NUMBERS:
        raise InvalidInput(
            f"model: expected at most {MOST_NUMBERS:,} numbers, got {source.numbers:,}: use the model family "
            "sparse_gaussian_process, which has fewer"
        )
    return source


def _variables(definition: EnvironmentDefinition) -> Iterator[Variable]:
    """Yield the variables of the FMU, in the order of the values in ``twin.c``.

    If two have the same name, the second gets its kind as a prefix, such as ``observation``.
    """
    free = Names().free

    action, count = definition.action, definition.action.size
    for entry in range(count):
        name = free("action" if count == 1 else f"action_{entry}", "input")
        if action.nvec:
            yield Variable(name, "Int32", "input", 0, 0, action.nvec[entry] - 1)
        else:
            low, high = action.ranges[entry]
            yield Variable(name, "Float64", "input", min(max(0.0, low), high), low, high)
    for index, coordinate in enumerate(definition.coordinates):
        yield _coordinate(coordinate, free(coordinate.name, "state"), _start(definition, index))
    for name in definition.observation_names:
        yield Variable(free(name, "observation"), "Float64", "output", description="observation")
    for name in definition.outputs:
        about = f"standard deviation of what the model does not know of {name} in the last step"
        yield Variable(free(f"deviation.{name}", "twin"), "Float64", "output", description=about)
    yield Variable(free("reward", "twin"), "Float64", "output", description="mean reward of the last step")
    about = "whether an episode ends here; the next step starts here all the same"
    yield Variable(free("terminated", "twin"), "Boolean", "output", description=about)


def _coordinate(coordinate: Coordinate, name: str, start: float) -> Variable:
    low, high = (limit if math.isfinite(limit) else None for limit in coordinate.saturation)
    unit = coordinate.unit or ("rad" if coordinate.kind == "angle" else "")
    causality: Causality = "parameter" if coordinate.kind == "constant" else "output"
    return Variable(name, "Float64", causality, start, low, high, unit, "coordinate of the state")


def _start(definition: EnvironmentDefinition, index: int) -> float:
    """Return the start value of coordinate number ``index``: its value in the first declared start state, or the median
    of its start distribution if no start state is declared."""
    if definition.starts:
        return definition.starts[0][index]
    middle = torch.tensor(0.5, dtype=torch.float64)
    return float(quantile(definition.start[index], middle))


def _header(definition: EnvironmentDefinition, model: DynamicsModel, rewards: tuple[float, float]) -> Iterator[str]:
    action, coordinates = definition.action, definition.coordinates
    low, high = zip(*action.ranges, strict=True)
    yield "/* Sizes and limits of a surrogate. */"
    yield f"enum {{ COORDINATES = {len(coordinates)}, ACTIONS = {action.size} }};"
    yield f"enum {{ OBSERVATIONS = {len(definition.observation_names)}, OUTPUTS = {len(definition.outputs)} }};"
    yield f"#define TERMINAL_REWARD {_written(model.terminal_reward)}"
    yield f"#define REWARD_LOW {_written(rewards[0])}"
    yield f"#define REWARD_HIGH {_written(rewards[1])}"
    yield _array("action_low", low)
    yield _array("action_high", high)
    low, high = zip(*(one.saturation for one in coordinates), strict=True)
    yield _array("state_low", [max(one, -_LARGEST) for one in low])
    yield _array("state_high", [min(one, _LARGEST) for one in high]) + "\n"


_LARGEST = torch.finfo(torch.float64).max  # replaces infinite bounds, so that the FMU refuses an infinite start value


def _array(name: str, values: Sequence[float]) -> str:
    return f"static const double {name}[] = {{{', '.join(map(_written, values))}}};"


def _written(value: float) -> str:
    return repr(float(value)).replace("inf", "INFINITY")
