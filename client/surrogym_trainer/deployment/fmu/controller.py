"""A controller as an FMU, which decides at the beginning of each sampling period from the values of its inputs at that
time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from string import Template
from tempfile import TemporaryDirectory

from surrogym_shared.fmu import Block, Names, Variable, write_fmu
from surrogym_trainer.deployment.c.files import prefix_of, write_sources
from surrogym_trainer.deployment.c.source import number
from surrogym_trainer.deployment.controller import Controller, NotDeployable

STATUS = "0, or a sum of 1: not finite, 2: out of range, 4: late, 8: the network has no action"


def write(controller: Controller, folder: Path) -> None:
    """Write a controller as an FMU into a folder, with native code if a C compiler is installed.

    Raises:
        NotDeployable: no sampling period is declared, or two variables have the same name.
        CannotCompile: the compiler refused the sources.
    """
    try:
        write_fmu(block_of(controller), folder / f"{prefix_of(controller)}_controller.fmu")
    except ValueError as error:
        raise NotDeployable(str(error)) from error


def block_of(controller: Controller) -> Block:
    """Return a controller as the block that an FMU is made from. Raises ``NotDeployable`` if no sampling period is
    declared."""
    if controller.period is None:
        raise NotDeployable(
            "an FMU needs a period, and none is declared: give it by --period, or by sampling_period in the "
            "specification"
        )
    prefix = prefix_of(controller)
    names = {"prefix": prefix, "PREFIX": prefix.upper(), "fallback": ", ".join(map(number, controller.fallback))}
    glue = Template(files(__package__).joinpath("block.c.txt").read_text(encoding="utf-8")).substitute(names)
    digests = ", ".join(f"{name} {value[:16]}" for name, value in sorted(controller.digests.items()))
    return Block(
        name=f"{prefix}_controller",
        description=f"Controller of {controller.name}: {digests}",
        variables=tuple(_variables(controller)),
        period=controller.period,
        stop=None,
        sources={**_sources(controller), f"{prefix}_block.c": glue},
        memory=len(controller.coordinates) + len(controller.low) + 1,
        acts_first=True,
    )


def _sources(controller: Controller) -> dict[str, str]:
    """Return the header and the source of the controller in C, by file name."""
    with TemporaryDirectory() as folder:
        write_sources(controller, Path(folder))
        return {path.name: path.read_text(encoding="utf-8") for path in sorted(Path(folder).iterdir())}


def _variables(controller: Controller) -> Iterator[Variable]:
    """Yield all variables of a controller's FMU, in the order in which ``block.c.txt`` reads their values. If a name is
    already used, the variable's kind is put before the name."""
    free = Names().free
    for one in controller.measurements:
        about = f"measurement, from {one.lowest:.6g} to {one.highest:.6g}"
        start = min(max(0.0, one.lowest), one.highest)
        yield Variable(free(one.name, "measurement"), "Float64", "input", start, unit=one.unit, description=about)
    about = "of the measurements, in seconds"
    yield Variable(free("age", "controller"), "Float64", "input", 0.0, description=about)
    for index, (low, high) in enumerate(zip(controller.low.tolist(), controller.high.tolist(), strict=True)):
        name = "action" if len(controller.low) == 1 else f"action_{index}"
        ends = (low, high) if math.isfinite(low) and math.isfinite(high) else (None, None)
        yield Variable(free(name, "controller"), "Float64", "output", None, *ends)
    yield Variable(free("status", "controller"), "Int32", "output", description=STATUS)
