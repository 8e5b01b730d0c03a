"""The files of a controller in C99, and their layout for Arduino and PlatformIO."""

from __future__ import annotations

import json
import re
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from surrogym_trainer.deployment.c import source
from surrogym_trainer.deployment.controller import Array, Controller, NotDeployable
from surrogym_trainer.deployment.vectors import Vector, vectors_of

LONGEST = 2_000_000  # longest period of an Arduino sketch in seconds; the sketch's clock can count 2^31 milliseconds


def prefix_of(controller: Controller) -> str:
    """Return the prefix of all C names of a controller: the surrogate's name, with other characters than letters and
    digits replaced."""
    name = re.sub(r"[^A-Za-z0-9]+", "_", controller.name).strip("_").lower() or "policy"
    return f"p{name}" if name[0].isdigit() else name


def write(controller: Controller, folder: Path) -> None:
    """Write header, source, and the program that runs test vectors into a folder."""
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
