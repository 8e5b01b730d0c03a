"""The files of a controller in C99, their layout for Arduino and PlatformIO, test vectors, and compilation on this
machine.

Test vectors are steps of episodes, with the answers that the controller must give. A compiled program is driven by
lines of JSON, as original environments are.

Shapes: R measurements, F action entries.
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from string import Template
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from surrogym_sampler.original.executables.messages import numbers
from surrogym_sampler.original.executables.program import Program
from surrogym_shared.c_compiler import CannotCompile, compile_c, require_c_compiler
from surrogym_trainer.deployment.c import source
from surrogym_trainer.deployment.controller import Array, Controller, NotDeployable
from surrogym_trainer.deployment.reference import Memory, begin, decide, judged
from surrogym_trainer.deployment.running import Running

EPISODES, STEPS, TRIES = 3, 16, 20
WALKED = 20.0  # the random walk of an angle stays within this distance in radians of 0
ROUNDING = 1e-6  # relative error of a measurement that is rounded to float32
# a measurement is used only if rounding it changes the action by at most this share of the action's range
STEADY = 2e-5


@dataclass(frozen=True, eq=False)
class Vector:
    """One step of a test, and the answer that the controller must give."""

    first: bool  # whether this step begins an episode
    measurement: Array  # (R,) value of each of R measurements
    age: float  # age of the measurements in seconds
    status: int
    action: Array  # (F,) action that the controller must give, one number for each of F entries


def vectors_of(controller: Controller) -> list[Vector]:
    """Return the test vectors: random walks, ends of the sensors' ranges, and each kind of fault with steps after it.

    A measurement whose rounding to float32 would change the action, such as an angle at half a turn, is left out. If no
    measurement without a fault is left then, such measurements are kept: then float is not precise enough for this
    policy, and the test fails.
    """
    vectors = _vectors_of(controller, np.random.default_rng(0), only_steady=True)
    if all(vector.status for vector in vectors):
        return _vectors_of(controller, np.random.default_rng(0), only_steady=False)
    return vectors


def _vectors_of(controller: Controller, rng: np.random.Generator, *, only_steady: bool) -> list[Vector]:
    low, high = sensors_of(controller)
    narrow = _walked(controller)
    inside = low + ROUNDING * (high - low), high - ROUNDING * (high - low)
    vectors: list[Vector] = []
    for _ in range(EPISODES):
        memory, first = begin(controller), True
        walk = rng.uniform(*narrow)
        for step in range(STEPS):
            for _ in range(TRIES):
                drawn = np.clip(walk + rng.normal(0, 0.05, len(low)) * (narrow[1] - narrow[0]), *inside)
                read = drawn.astype(np.float32).astype(np.float64)
                if step == 5:
                    read = (low if rng.random() < 0.5 else high).copy()
                elif judged(controller, read[None], np.zeros(1))[0]:
                    continue  # rounding moved the measurement beyond the end of its range
                if _is_steady(controller, memory, read) or not only_steady:
                    walk = read
                    memory, vector = _answered(controller, memory, first, read, 0.0)
                    vectors.append(vector)
                    first = False
                    break
    memory, first = begin(controller), True
    for read, age in _faults(controller, rng, low, high):
        if age != 0 or not np.isfinite(read).all() or _is_steady(controller, memory, read):
            memory, vector = _answered(controller, memory, first, read, age)
            vectors.append(vector)
            first = False
    return vectors


def sensors_of(controller: Controller) -> tuple[Array, Array]:
    """Return the smallest and the largest valid reading (R,) of each sensor."""
    measurements = controller.measurements
    return np.array([m.lowest for m in measurements]), np.array([m.highest for m in measurements])


def _walked(controller: Controller) -> tuple[Array, Array]:
    """Return the range (R,) of the random walk of each measurement: the range of its sensor. For an angle whose sensor
    counts many turns, it is a few turns only."""
    low, high = sensors_of(controller)
    near = np.clip(0.0, low, high)
    angle = np.array([m.angle for m in controller.measurements])
    return np.where(angle, np.maximum(low, near - WALKED), low), np.where(angle, np.minimum(high, near + WALKED), high)


def _faults(controller: Controller, rng: np.random.Generator, low: Array, high: Array) -> Iterator[tuple[Array, float]]:
    """Yield measurements (R,) and their ages in seconds: faults, each followed by steps without a fault."""
    begun, ended = _walked(controller)

    def sound() -> tuple[Array, float]:
        read = (begun + ended) / 2 + rng.uniform(-0.1, 0.1, len(low)) * (ended - begun)
        return read.astype(np.float32).astype(np.float64), 0.0

    for wrong in (np.nan, np.inf, -np.inf):
        for place in range(len(low)):
            read, _ = sound()
            read[place] = wrong
            yield read, 0.0
            yield sound()
            yield sound()
    for end, sign in ((low, -1), (high, 1)):
        yield end + sign * 0.01 * (high - low), 0.0
        yield sound()
    ages = [np.nan, -1.0, np.inf] + ([] if np.isinf(controller.timeout) else [1.01 * controller.timeout])
    for age in ages:
        if not (age == np.inf and np.isinf(controller.timeout)):
            yield sound()[0], age
            yield sound()


def _answered(controller: Controller, memory: Memory, first: bool, read: Array, age: float) -> tuple[Memory, Vector]:
    decided = decide(controller, memory, read[None], age)
    return decided.memory, Vector(first, read, age, int(decided.status[0]), decided.action[0])


def _is_steady(controller: Controller, memory: Memory, read: Array) -> bool:
    """Return whether the controller's action for the measurements ``read`` (R,) stays the same, but for a small share
    of its range, if the measurements change by as much as rounding to float32 may change them."""
    both = np.stack([read, read * (1 + ROUNDING), read * (1 - ROUNDING)]).clip(*sensors_of(controller))
    repeated = Memory(*(np.repeat(part, 3, axis=0) for part in vars(memory).values()))
    action = decide(controller, repeated, both).action
    middle = action[0]
    return bool((np.abs(action - middle) <= STEADY * (controller.high - controller.low)).all())


LONGEST = 2_000_000  # longest period of an Arduino sketch in seconds; the sketch's clock can count 2^31 milliseconds


def prefix_of(controller: Controller) -> str:
    """Return the prefix of all C names of a controller: the surrogate's name, with other characters than letters and
    digits replaced."""
    name = re.sub(r"[^A-Za-z0-9]+", "_", controller.name).strip("_").lower() or "policy"
    return f"p{name}" if name[0].isdigit() else name


def write(controller: Controller, folder: Path) -> None:
    """Write into a folder: the header and the source in C, and the source of the program that runs test vectors."""
    write_sources(controller, folder)
    prefix = prefix_of(controller)
    (folder / f"{prefix}_main.c").write_text(main_of(controller, vectors_of(controller)), encoding="utf-8")


def write_arduino(controller: Controller, folder: Path) -> None:
    """Write a library for the Arduino IDE and PlatformIO: the C header and source, and a sketch that uses them."""
    prefix = prefix_of(controller)
    (folder / "src").mkdir()
    write_sources(controller, folder / "src", single=True)
    name = f"{prefix}_controller"
    library = {
        "name": name,
        "version": "1.0.0",
        "description": _title(controller),
        "frameworks": "*",
        "platforms": "*",
        "headers": f"{name}.h",
    }
    (folder / "library.json").write_text(json.dumps(library, indent=2) + "\n", encoding="utf-8")
    properties = {
        "name": name,
        "version": "1.0.0",
        "author": "surrogym deploy",
        "maintainer": "surrogym deploy",
        "sentence": source.plain(_title(controller)),
        "paragraph": "One call per sampling period.",
        "category": "Device Control",
        "url": "",
        "architectures": "*",
        "includes": f"{name}.h",
    }
    lines = (f"{key}={value}" for key, value in properties.items())
    (folder / "library.properties").write_text("\n".join([*lines, ""]), encoding="utf-8")
    sketch = folder / "examples" / "control"
    sketch.mkdir(parents=True)
    content = _template("sketch.ino").substitute(_names(controller), **_clock(controller))
    (sketch / "control.ino").write_text(content, encoding="utf-8")


def main_of(controller: Controller, vectors: list[Vector]) -> str:
    """Return the source of the program that runs test vectors."""
    rows = [
        f"    {{{int(v.first)}, {{{_joined(v.measurement)}}}, {source.number(v.age)}, {v.status}, "
        f"{{{_joined(v.action)}}}}},"
        for v in vectors
    ]
    ranges = _joined(controller.high - controller.low)
    return _template("main.c").substitute(_names(controller), vectors="\n".join(rows), ranges=ranges)


def write_sources(controller: Controller, folder: Path, *, single: bool = False) -> None:
    """Write header and source into a folder. With ``single``, the header itself chooses float, because a sketch has no
    compiler flags."""
    names, prefix = _names(controller), prefix_of(controller)
    flag = f"{prefix.upper()}_FLOAT"
    chosen = {"single": f"#ifndef {flag}\n#define {flag}\n#endif\n" if single else ""}
    chosen["numbers_are"] = "float" if single else f"double, or float with -D{flag}"
    for ending, parts in (("h", _header(controller) | chosen), ("c", source.parts_of(controller, prefix))):
        content = _template(f"controller.{ending}").substitute(names, **parts)
        content = re.sub(r"\n{3,}", "\n\n", content)
        (folder / f"{prefix}_controller.{ending}").write_text(content, encoding="utf-8")


def _header(controller: Controller) -> dict[str, Any]:
    measured = [
        f"measurement[{i}]  {m.name}{_in(m.unit)}, from {m.lowest:.6g} to {m.highest:.6g}"
        f"{', wrapped to a turn' if m.angle else ''}"
        for i, m in enumerate(controller.measurements)
    ]
    choices = controller.counts or (0,) * len(controller.low)
    acted = [
        f"action[{i}]  from {low:.6g} to {high:.6g}{f', one of {n} evenly spaced values' if n else ''}"
        for i, (low, high, n) in enumerate(zip(controller.low, controller.high, choices, strict=True))
    ]
    observed = [f"observation[{i}]  {o.name}{_in(o.unit)}" for i, o in enumerate(controller.observation)]
    return {
        "digests": "\n".join(_digest(controller, name, value) for name, value in sorted(controller.digests.items())),
        "measured": _comment(measured),
        "acted": _comment(acted),
        "observed": _comment(observed),
        "period": "sampling period" if controller.period is None else f"{controller.period:g} s",
        "late": controller.late,
        "fallback": ", ".join(f"{a:g}" for a in controller.fallback),
        "numbers": source.stack_of(controller),
        "constants": f"{source.constants_of(controller):,}",
        **_limits(controller),
        "R": len(controller.measurements),
        "F": len(controller.low),
        "D": len(controller.observation),
        "C": len(controller.coordinates),
    }


def _limits(controller: Controller) -> dict[str, str]:
    """Return the parts of the header that concern limits; they are empty if the controller has no limits."""
    if controller.guard is None:
        return {"limited_bit": "", "rooms": "", "keeps": ""}
    names = ", ".join(source.plain(limit.term.name) for limit in controller.guard.limits)
    prefix = prefix_of(controller)
    return {
        "limited_bit": f",\n    {prefix.upper()}_LIMITED = 16 /* the fallback of the limits acts: no fault */",
        "rooms": f"    {prefix}_real room[{len(controller.guard.limits)}]; /* distance to each limit */\n",
        "keeps": f" * Limits that it keeps: {names}. Shortly before one, a fallback of their own acts.\n",
    }


def _digest(controller: Controller, name: str, value: str) -> str:
    """Return a digest as a C definition of a text, so that a running machine can print which controller it has."""
    return f"#define {prefix_of(controller).upper()}_{name.replace(' ', '_').upper()}_SHA256 {source.text(value)}"


def _names(controller: Controller) -> dict[str, str]:
    prefix = prefix_of(controller)
    return {"prefix": prefix, "PREFIX": prefix.upper(), "title": source.plain(_title(controller))}


def _title(controller: Controller) -> str:
    return f"Controller of {controller.name}"


def _clock(controller: Controller) -> dict[str, str]:
    """Return the names and numbers of the sketch's 32-bit clock: microseconds if the period and the timeout fit, else
    milliseconds."""
    if controller.period is None:
        raise NotDeployable(
            "a sketch needs a period, and none is declared: give it by --period, or by sampling_period in the "
            "specification"
        )
    longest = max(controller.period, controller.timeout)
    if longest > LONGEST:
        raise NotDeployable(
            f"expected a period and a timeout of at most {LONGEST:,} s for a sketch, got {longest:g} s: give smaller "
            "ones"
        )
    unit, clock, second = ("us", "micros", 1_000_000) if longest < LONGEST / 1000 else ("ms", "millis", 1000)
    period = max(1, round(second * controller.period))
    return {"period": str(period), "unit": unit, "clock": clock, "second": str(second)}


def _in(unit: str) -> str:
    return f" in {unit}" if unit else ""


def _comment(lines: list[str]) -> str:
    return "\n".join(f" *   {source.plain(line)}" for line in lines)


def _joined(values: Array) -> str:
    return ", ".join(source.number(value) for value in values)


def _template(name: str) -> Template:
    return Template(files(__package__).joinpath(f"{name}.txt").read_text(encoding="utf-8"))


FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror")
SECONDS = 10.0  # the compiled program is stopped if it has not answered within this number of seconds


class CompiledController(Running):
    """A compiled controller, running as a program.

    Args:
        program: the program made from the controller's C sources.
        actions: number of entries of an action, F.
        microseconds: duration of one decision.
        single: whether it computes in float instead of double.
    """

    def __init__(self, program: Program, actions: int, microseconds: float, single: bool) -> None:
        self._program, self._actions = program, actions
        self.microseconds, self.single = microseconds, single

    def reset(self) -> None:
        self._program.ask("reset", time.monotonic() + SECONDS)

    def step(self, measurement: Array, age: float = 0.0) -> tuple[int, Array]:
        sent = [float(value) for value in measurement]
        reply = self._program.ask("step", time.monotonic() + SECONDS, measurement=sent, age=float(age))
        return int(reply["status"]), numbers(reply, "action", self._actions)


@contextmanager
def running(controller: Controller, *, single: bool = False) -> Iterator[CompiledController]:
    """Compile a controller, run its test vectors, and start it; with ``single`` it computes in float instead of double.

    Raises:
        CannotCompile: there is no C compiler, or it refuses the controller.
        NotDeployable: the compiled controller fails a test vector.
    """
    with TemporaryDirectory() as made:
        folder = Path(made)
        write(controller, folder)
        executable = folder / "controller"
        sources = sorted(path.name for path in folder.glob("*.c"))
        flags = (*FLAGS, f"-D{prefix_of(controller).upper()}_FLOAT") if single else FLAGS
        compile_c(require_c_compiler(), flags, sources, executable, folder)
        try:
            vectors = subprocess.run([executable], capture_output=True, text=True, check=False)
        except OSError as error:
            raise CannotCompile(
                f"expected a C compiler for this machine, got one whose program can't run here: {error.strerror}; "
                "set the variable CC to another one"
            ) from error
        if vectors.returncode != 0:
            raise NotDeployable(
                "the compiled controller gives other actions than the policy for its test observations, so it is not "
                f"used: try another C compiler (variable CC), or report this: {vectors.stdout[-400:]}"
            )
        timed = subprocess.run([executable, "time"], capture_output=True, text=True, check=True)
        program = Program(shlex.join([str(executable), "lines"]), "the compiled controller")
        program.start()
        try:
            yield CompiledController(program, len(controller.low), float(timed.stdout) / 1000, single)
        finally:
            program.close()
