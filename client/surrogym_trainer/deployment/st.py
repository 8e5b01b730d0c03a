"""The target ``st``: a controller as one function block of structured text of IEC 61131-3, for programmable logic
controllers, with its numbers in constant arrays.

``surrogym_trainer.deployment.reference`` computes the same in NumPy. Names avoid the keywords of IEC 61131-3, such
as ACTION and STEP. The block calls no functions other than EXP, SIN, COS, TRUNC and conversions of types.

Shapes: R measurements, D observation entries, A outputs, F action entries.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from surrogym_trainer.deployment.c.files import prefix_of
from surrogym_trainer.deployment.controller import Controller, Decision, Dense, KeptLimit, NotDeployable, Observed, Part

REAL_TYPES = ("LREAL", "REAL")  # types of numbers with 64 and with 32 bits
LARGEST = {"LREAL": float(np.finfo(np.float64).max), "REAL": 3.4028234e38}
PER_LINE = 5  # number of constants in each line of a generated array
# an angle's reading may be at most this number of turns from 0, because TRUNC returns a DINT (32 bits)
MOST_TURNS = 1e9
KINDS = ("action", "steps", "value", "change", "sum")

WRAP = """\
value := value + HALF_TURN;
value := value - TURN * DINT_TO_$real(TRUNC(value / TURN));
IF value < 0.0 THEN
    value := value + TURN;
END_IF
value := value - HALF_TURN;"""

LAGS = """\
FOR i := 0 TO $last DO
    value := LAG_START[i];
    CASE LAG_KIND[i] OF
        0: (* a command *)
            IF acted THEN
                value := remembered[LAG_SOURCE[i]];
            END_IF
        1: (* steps since the start *)
            IF known THEN
                value := before[LAG_PLACE[i]] + 1.0;
            END_IF
        2: (* the value before *)
            IF known OR (acted AND LAG_OF_COMMAND[i]) THEN
                value := before[LAG_SOURCE[i]];
            END_IF
        3: (* the change of the last step *)
            IF known THEN
                value := q[LAG_SOURCE[i]] - before[LAG_SOURCE[i]];
                IF LAG_ANGLE[i] THEN
$wrap
                END_IF
            END_IF
$sums    END_CASE
    IF value < LAG_LOW[i] THEN
        value := LAG_LOW[i];
    ELSIF value > LAG_HIGH[i] THEN
        value := LAG_HIGH[i];
    END_IF
    q[LAG_PLACE[i]] := value;
END_FOR"""

SUMS = """\
        4: (* the integral of an error, which a fault holds *)
            IF acted THEN
                value := before[LAG_PLACE[i]];
                IF status = 0 THEN
                    value := value + (q[LAG_SOURCE[i]] - LAG_SET_POINT[i]) / LAG_UNIT[i];
                END_IF
            END_IF
"""

LAYER = """\
FOR k := 0 TO $last DO
    $to[k] := BIAS$number[k];
END_FOR
FOR i := 0 TO $last_input DO
    FOR k := 0 TO $last DO
        $to[k] := $to[k] + $from_[i] * WEIGHTS$number[$outputs * i + k];
    END_FOR
END_FOR"""

RELU = """\
FOR k := 0 TO $last DO
    IF $to[k] < 0.0 THEN
        $to[k] := 0.0;
    END_IF
END_FOR"""

TANH = """\
FOR k := 0 TO $last DO (* tanh *)
    IF $to[k] > 20.0 THEN
        $to[k] := 1.0;
    ELSIF $to[k] < -20.0 THEN
        $to[k] := -1.0;
    ELSE
        $to[k] := 1.0 - 2.0 / (EXP($to[k] + $to[k]) + 1.0);
    END_IF
END_FOR"""

CONTINUOUS = """\
FOR i := 0 TO $last DO
    value := CENTRE[i] + REACH[i] * $y[i];
    IF value < COMMAND_LOW[i] THEN
        value := COMMAND_LOW[i];
    ELSIF value > COMMAND_HIGH[i] THEN
        value := COMMAND_HIGH[i];
    END_IF
    command[i] := value;
END_FOR"""

DISCRETE = """\
first := 0;
FOR i := 0 TO $last DO (* the largest output of each group *)
    best := first;
    FOR k := first + 1 TO first + CHOICES[i] - 1 DO
        IF $y[k] > $y[best] THEN
            best := k;
        END_IF
    END_FOR
    value := DINT_TO_$real(best - first) / DINT_TO_$real(CHOICES[i] - 1);
    command[i] := COMMAND_LOW[i] + value * (COMMAND_HIGH[i] - COMMAND_LOW[i]);
    first := first + CHOICES[i];
END_FOR"""


def write(controller: Controller, folder: Path) -> None:
    """Write two function blocks into a folder: one with numbers of 64 bits, one with numbers of 32 bits."""
    for real in REAL_TYPES:
        name = f"{prefix_of(controller)}_controller{'' if real == 'LREAL' else '_real'}"
        (folder / f"{name}.st").write_text(source_of(controller, real, name), encoding="utf-8")


def source_of(controller: Controller, real: str, name: str) -> str:
    """Return the source of the function block called ``name``, with numbers of the type ``real``.

    Raises:
        NotDeployable: the sensor of an angle may give more turns than a DINT can count.
    """
    for one in controller.measurements:
        if one.angle and max(-one.lowest, one.highest) > 2 * np.pi * MOST_TURNS:
            raise NotDeployable(
                f"expected --range of the angle {one.name} within {MOST_TURNS:g} turns of 0, because TRUNC counts no "
                "more turns: narrow it"
            )
    sizes, decision = _sizes(controller.decision), controller.decision
    last = {
        "R": len(controller.measurements),
        "F": len(controller.low),
        "D": len(controller.observation),
        "C": len(controller.coordinates),
        "A": sizes[-1],
        "X": max(sizes[::2]),
        "Y": max(sizes[1::2]),
    }
    wrap, outputs = Template(WRAP).substitute(real=real), "x" if len(sizes) % 2 else "y"
    decide = Template(DISCRETE if decision.counts else CONTINUOUS)
    squash = Template(TANH).substitute(last=sizes[-1] - 1, to=outputs) + "\n" if decision.squash else ""
    sums = SUMS if any(lag.kind == "sum" for lag in controller.lags) else ""
    lags = Template(LAGS).substitute(last=len(controller.lags) - 1, wrap=_indented(20, wrap), sums=sums)
    rounded = _rounded if real == "LREAL" else str
    return _template().substitute(
        _comments(controller),
        name=name,
        real=real,
        **{f"last{size}": count - 1 for size, count in last.items()},
        constants=_indented(4, "\n".join(_constants(controller, real))),
        wrap=_indented(12, wrap),
        lags=lags if controller.lags else "",
        observe=_indented(4, "\n".join(_observation(controller.observation, rounded))),
        network=_indented(4, "\n".join(_layers(decision.layers))),
        y=outputs,
        **_guard(controller, real),
        rates="".join(Template(RATED).substitute(rate) for rate in _rates(controller, real)),
        decide=_indented(4, squash + decide.substitute(last=last["F"] - 1, y=outputs, real=real)),
        rounded_command=rounded("command[i]"),
    )


RATED = """\
(* A command changes by at most $change in a step. *)
IF command[$entry] < q[$last] - $change THEN
    command[$entry] := q[$last] - $change;
ELSIF command[$entry] > q[$last] + $change THEN
    command[$entry] := q[$last] + $change;
END_IF
"""


def _rates(controller: Controller, real: str) -> Iterable[dict[str, str]]:
    """Yield the values of the template ``RATED`` for each entry of the action with a largest change per step (rate), as
    numbers of the type ``real``."""
    for rate in controller.rates:
        yield {"entry": str(rate.entry), "last": str(rate.last), "change": _number(rate.change, real)}


GUARDED = """\
(* Limits: their fallback acts shortly before one would be left. *)
IF measured THEN
    limited := FALSE;
$limits
    IF limited THEN
        status := 16;
$fallback
    END_IF
END_IF"""


def _guard(controller: Controller, real: str) -> dict[str, str]:
    """Return the parts of the source that replace the policy's action if a limit would be left soon; they are empty if
    the controller has no limits. The source computes the rule of ``surrogym_shared.limits.is_near``."""
    guard = controller.guard
    if guard is None:
        return {"guard": "", "guard_variables": "", "limited": ""}
    limits: list[str] = []
    fallback: list[str] = []
    for i, limit in enumerate(guard.limits):
        margin = _number(limit.margin, real)
        limits += [f"(* {plain(limit.term.name)} *)", *_value(limit.term), "now := LARGEST;"]
        limits += [f"IF {room} < now THEN\n    now := {room};\nEND_IF" for room in _rooms(limit)]
        limits += [
            "soon := now;",
            f"IF known THEN\n    soon := now + now - room[{i}];\nEND_IF",
            f"room[{i}] := now;",
            f"IF now < {margin} OR soon < {margin} THEN\n    limited := TRUE;\nEND_IF",
        ]
    for i, term in enumerate(guard.fallback):
        fallback += [*_value(term), f"command[{i}] := value;"]
    body = Template(GUARDED).substitute(
        limits=_indented(4, "\n".join(limits)), fallback=_indented(8, "\n".join(fallback))
    )
    variables = f"    room : ARRAY[0..{len(guard.limits) - 1}] OF {real}; (* distance to each limit *)\n"
    return {
        "guard": f"{body}\n",
        "guard_variables": f"{variables}    now, soon : {real};\n    limited : BOOL;\n",
        "limited": ", 16: the fallback of the limits acts",
    }


def _rooms(limit: KeptLimit) -> Iterable[str]:
    """Yield, as source, the distance of the variable ``value`` from each finite end of a limit."""
    if math.isfinite(limit.low):
        yield _sum([(1.0, "value"), (-limit.low, "")])
    if math.isfinite(limit.high):
        yield _sum([(limit.high, ""), (-1.0, "value")])


def _value(term: Observed) -> Iterable[str]:
    """Yield the source lines that compute a term, and clip it to its range, in the variable ``value``."""
    yield f"value := {_sum(map(_part, term.parts))};"
    for sign, limit in (("<", term.low), (">", term.high)):
        if math.isfinite(limit):
            literal = _number(limit, "LREAL")
            yield f"IF value {sign} {literal} THEN\n    value := {literal};\nEND_IF"


def _constants(controller: Controller, real: str) -> Iterable[str]:
    decision, measured, lags = controller.decision, controller.measurements, controller.lags
    scalars = {"LARGEST": LARGEST[real], "TIMEOUT": controller.timeout, "CLIP": decision.clip}
    scalars |= {"TURN": 2 * math.pi, "HALF_TURN": math.pi}
    yield from (f"{name} : {real} := {_number(value, real)};" for name, value in scalars.items())
    numbers: dict[str, Any] = {
        "LOWEST": [one.lowest for one in measured],
        "HIGHEST": [one.highest for one in measured],
        "MEASURED_LOW": [one.low for one in measured],
        "MEASURED_HIGH": [one.high for one in measured],
        "MEAN": decision.mean,
        "DEVIATION": decision.deviation,
    }
    for number, layer in enumerate(decision.layers):
        numbers |= {f"WEIGHTS{number}": layer.weights, f"BIAS{number}": layer.bias}
    if not decision.counts:
        numbers |= {"CENTRE": decision.centre, "REACH": decision.reach}
    numbers |= {"COMMAND_LOW": controller.low, "COMMAND_HIGH": controller.high, "FALLBACK": controller.fallback}
    wholes: dict[str, Sequence[int]] = {"PLACE": [one.place for one in measured]}
    truths: dict[str, Sequence[bool]] = {"ANGLE": [one.angle for one in measured]}
    if decision.counts:
        wholes["CHOICES"] = decision.counts
    if lags:
        ends = ("start", "low", "high", *(("set_point", "unit") if any(one.kind == "sum" for one in lags) else ()))
        numbers |= {f"LAG_{end.upper()}": [getattr(one, end) for one in lags] for end in ends}
        wholes |= {
            "LAG_KIND": [KINDS.index(one.kind) for one in lags],
            "LAG_PLACE": [one.place for one in lags],
            "LAG_SOURCE": [one.source for one in lags],
        }
        truths |= {"LAG_ANGLE": [one.angle for one in lags], "LAG_OF_COMMAND": [one.of_action for one in lags]}
    for name, values in numbers.items():
        yield _array(name, real, [_number(value, real) for value in np.ravel(values)])
    yield from (_array(name, "DINT", list(map(str, values))) for name, values in wholes.items())
    yield from (_array(name, "BOOL", [str(value).upper() for value in values]) for name, values in truths.items())


def _array(name: str, kind: str, values: Sequence[str]) -> str:
    rows = [", ".join(values[begin : begin + PER_LINE]) for begin in range(0, len(values), PER_LINE)]
    return f"{name} : ARRAY[0..{len(values) - 1}] OF {kind} := [\n    " + ",\n    ".join(rows) + "];"


def _number(value: float, real: str) -> str:
    """Return a number as a literal with a decimal point; an infinity becomes the largest finite number."""
    limited = min(max(float(value), -LARGEST[real]), LARGEST[real])
    digits, _, exponent = (repr(limited) if real == "LREAL" else str(np.float32(limited))).partition("e")
    point = digits if "." in digits else f"{digits}.0"
    return f"{point}E{int(exponent)}" if exponent else point


def _observation(entries: Iterable[Observed], rounded: Callable[[str], str]) -> Iterable[str]:
    for index, entry in enumerate(entries):
        yield f"(* {plain(entry.name)} *)"
        yield from _value(entry)
        yield f"observation[{index}] := {rounded('value')};"


def _sum(terms: Iterable[tuple[float, str]]) -> str:
    """Return the source of a weighted sum. Each term is a weight and the text that it multiplies; an empty text stands
    for 1. Weights of 1, and two signs in a row, are not written."""
    written = ""
    for weight, of in terms:
        size = _number(abs(weight), "LREAL")
        term = size if not of else of if abs(weight) == 1 else f"{size} * {of}"
        sign = "-" if weight < 0 else "+"
        written += f" {sign} {term}" if written else f"-{term}" if weight < 0 else term
    return written or "0.0"


def _part(part: Part) -> tuple[float, str]:
    inner = _sum((weight, f"q[{place}]") for place, weight in part.weights)
    plain_sum = inner if len(part.weights) == 1 and inner.startswith("q") else f"({inner})"
    shown = {"one": "", "linear": plain_sum, "sin": f"SIN({inner})", "cos": f"COS({inner})"}
    return part.coefficient, shown[part.function]


def _rounded(value: str) -> str:
    """Return the source that rounds a value to 32 bits, as observations and remembered actions are."""
    return f"REAL_TO_LREAL(LREAL_TO_REAL({value}))"


def _layers(layers: Sequence[Dense]) -> Iterable[str]:
    for number, layer in enumerate(layers):
        inputs, outputs = layer.weights.shape
        from_, to = ("x", "y") if number % 2 == 0 else ("y", "x")
        given = {"last": outputs - 1, "last_input": inputs - 1, "outputs": outputs, "number": number}
        yield Template(LAYER).substitute(given, from_=from_, to=to)
        if layer.activation != "none":
            yield Template(TANH if layer.activation == "tanh" else RELU).substitute(given, to=to)


def _sizes(decision: Decision) -> list[int]:
    return [len(decision.mean), *(len(layer.bias) for layer in decision.layers)]


def _comments(controller: Controller) -> dict[str, str]:
    measured = [
        f"measurement[{i}]  {one.name}{f' in {one.unit}' if one.unit else ''}, "
        f"from {one.lowest:.6g} to {one.highest:.6g}"
        for i, one in enumerate(controller.measurements)
    ]
    choices = controller.counts or (0,) * len(controller.low)
    acted = [
        f"command[{i}]  from {low:.6g} to {high:.6g}{f', one of {n} evenly spaced values' if n else ''}"
        for i, (low, high, n) in enumerate(zip(controller.low, controller.high, choices, strict=True))
    ]
    return {
        "title": plain(f"Controller of {controller.name}"),
        "digests": "\n".join(f"     {plain(value)}  {name}" for name, value in sorted(controller.digests.items())),
        "measured": "\n".join(f"     {plain(line)}" for line in measured),
        "acted": "\n".join(f"     {line}" for line in acted),
        "observed": plain(", ".join(one.name for one in controller.observation)),
        "period": "sampling period" if controller.period is None else f"{controller.period:g} s",
        "late": controller.late,
        "fallback": ", ".join(f"{action:g}" for action in controller.fallback),
    }


def plain(text: str) -> str:
    """Return a text without characters that would end a comment in structured text; names may contain any text."""
    printable = "".join(c if c.isprintable() else " " for c in text)
    return printable.replace("(*", "( *").replace("*)", "* )")


def _indented(spaces: int, text: str) -> str:
    return "\n".join(" " * spaces + line if line else line for line in text.split("\n"))


def _template() -> Template:
    return Template(files(__package__).joinpath("controller.st.txt").read_text(encoding="utf-8"))
