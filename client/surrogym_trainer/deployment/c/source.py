"""The parts of a controller's C source that depend on the policy.

Shapes: R measurements, D observation entries, A outputs, F action entries.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from itertools import pairwise

import numpy as np

from surrogym_trainer.deployment.controller import Array, Controller, Decision, Observed, Part

PER_LINE = 6  # number of constants in each line of a generated array
UNROLLED = 4  # the generated loop over the inputs of a layer adds the products of this number of inputs in each pass

WRAPPED = """
/* An angle in [-pi, pi). */
static real wrapped(real angle)
{
    real turned = MOD(angle + R(3.141592653589793), R(6.283185307179586));
    if (turned < 0)
        turned += R(6.283185307179586);
    return turned - R(3.141592653589793);
}
"""
CLIPPED = """
static real clipped(real value, real low, real high)
{
    return value < low ? low : value > high ? high : value;
}
"""
SQUASHED = """
/* tanh; its absolute error is about one rounding, in a third of the time. */
static real squashed(real x)
{
    return R(1.0) - R(2.0) / (EXP(x + x) + R(1.0));
}
"""


def number(value: float) -> str:
    """Return a number as an exact constant in C."""
    value = float(value)
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return repr(value)


def real(value: float) -> str:
    """Return a number as a C constant of the type ``real``; an infinity becomes the largest finite number."""
    if math.isinf(value):
        return "LARGEST" if value > 0 else "-LARGEST"
    return f"R({number(value)})"


def plain(text: str) -> str:
    """Return a text without characters that would end a comment in C; names may contain any text."""
    printable = "".join(c if c.isprintable() else " " for c in text)
    return re.sub(r"\?\?", "? ?", printable.replace("*/", "* /").replace("/*", "/ *").rstrip("\\"))


def text(value: str) -> str:
    """Return a text as a constant in C."""
    return json.dumps(plain(value))


def stack_of(controller: Controller) -> int:
    """Return the largest number of values that the controller has on the stack."""
    sizes = _sizes(controller.decision)
    return max(sizes[::2]) + max([*sizes[1::2], 0]) + len(controller.observation) + len(controller.coordinates)


def parts_of(controller: Controller, prefix: str) -> dict[str, str]:
    """Return the parts of the C source, by their names in the template. All C names begin with ``prefix``."""
    body = {
        "observation": _observation(controller.observation),
        "place": _place(controller),
        "network": _network(controller.decision),
        "decide": _decide(controller),
        "judge": _judge(controller),
        "in_time": _in_time(controller),
        "rates": _rates(controller),
        "fallback_lines": _lines(8, (f"action[{i}] = {real(a)};" for i, a in enumerate(controller.fallback))),
    }
    body |= _guard(controller, prefix)
    used = "".join(body.values())
    helpers = {"wrapped(": WRAPPED, "clipped(": CLIPPED, "squashed(": SQUASHED}
    return {
        "arrays": _arrays(controller),
        "helpers": "".join(code for call, code in helpers.items() if call in used),
        **body,
    }


def _guard(controller: Controller, prefix: str) -> dict[str, str]:
    """Return the parts of the source that replace the policy's action if a limit would be left soon; they are empty if
    the controller has no limits. The source computes the rule of ``surrogym_shared.limits.is_near`` in C."""
    guard = controller.guard
    if guard is None:
        return {"limited": "", "known": "", "guard": "", "not_limited": "status"}
    lines = ["const real *q = controller->coordinates;", "real now, soon;", "int acts = 0;"]
    for i, limit in enumerate(guard.limits):
        value, ends = _clipped(limit.term), []
        if math.isfinite(limit.low):
            ends.append(f"({value}) - {real(limit.low)}")
        if math.isfinite(limit.high):
            ends.append(f"{real(limit.high)} - ({value})")
        lines.append(f"now = {ends[0]}; /* {plain(limit.term.name)} */")
        if len(ends) > 1:
            lines += [f"soon = {ends[1]};", "now = soon < now ? soon : now;"]
        lines += [
            f"soon = known ? now + now - controller->room[{i}] : now;",
            f"acts |= (soon < now ? soon : now) < {real(limit.margin)};",
            f"controller->room[{i}] = now;",
        ]
    lines += ["if (acts) {", *(f"    action[{i}] = {_clipped(term)};" for i, term in enumerate(guard.fallback)), "}"]
    body = _lines(4, [*lines, "return acts;"])
    limited = f"{prefix.upper()}_LIMITED"
    return {
        "limited": "\n/* Whether the fallback of the limits acts. Then action is the fallback's. */\n"
        f"static int limited({prefix}_controller *controller, int known, real *action)\n{{\n{body}\n}}\n",
        "known": "    const int known = controller->acted && controller->measured;\n",
        "guard": f"        if (limited(controller, known, action))\n            status = {limited};\n",
        "not_limited": f"status & ~{limited}",
    }


def _rates(controller: Controller) -> str:
    """Return the C lines that limit the change of each action entry in a step to its rate; empty without rates."""
    lines = []
    for rate in controller.rates:
        last = f"controller->coordinates[{rate.last}]"
        ends = f"{last} - {real(rate.change)}, {last} + {real(rate.change)}"
        lines.append(f"action[{rate.entry}] = clipped(action[{rate.entry}], {ends});")
    return _lines(4, lines) + "\n" if lines else ""


def _clipped(term: Observed) -> str:
    value = " + ".join(_part(part) for part in term.parts)
    if math.isinf(term.low) and math.isinf(term.high):
        return value
    return f"clipped({value}, {real(term.low)}, {real(term.high)})"


def constants_of(controller: Controller) -> int:
    """Return the number of constants in the C source."""
    return sum(array.size for array in _constants(controller).values())


def _constants(controller: Controller) -> dict[str, Array]:
    decision = controller.decision
    arrays = {"MEAN": decision.mean, "DEVIATION": decision.deviation}
    for i, layer in enumerate(decision.layers):
        arrays |= {f"WEIGHTS{i}": layer.weights, f"BIAS{i}": layer.bias}
    if not decision.counts:
        arrays |= {"CENTRE": decision.centre, "REACH": decision.reach}
    return arrays | {"LOW": controller.low, "HIGH": controller.high}


def _arrays(controller: Controller) -> str:
    decision, arrays = controller.decision, _constants(controller)
    code = "#define R(number) ((real)(number))\n\n" + "".join(_array(name, array) for name, array in arrays.items())
    if decision.counts:
        code += f"static const int CHOICES[{len(decision.counts)}] = {{{', '.join(map(str, decision.counts))}}};\n"
    return code


def _array(name: str, array: Array) -> str:
    """Return the definition of a constant array in C. Weights (I, O) are stored flat, row by row."""
    numbers = [number(value) for value in array.ravel()]
    rows = (", ".join(numbers[i : i + PER_LINE]) for i in range(0, len(numbers), PER_LINE))
    return f"static const real {name}[{array.size}] = {{\n    " + ",\n    ".join(rows) + "};\n"


def _observation(entries: Iterable[Observed]) -> str:
    lines = []
    for i, entry in enumerate(entries):
        lines.append(f"observation[{i}] = (real)(float)({_clipped(entry)}); /* {plain(entry.name)} */")
    return _lines(4, lines)


def _part(part: Part) -> str:
    if part.function == "one":
        return real(part.coefficient)
    inner = " + ".join(f"q[{place}]" if w == 1 else f"{real(w)} * q[{place}]" for place, w in part.weights)
    value = {"linear": f"({inner})", "sin": f"SIN({inner})", "cos": f"COS({inner})"}[part.function]
    return value if part.coefficient == 1 else f"{real(part.coefficient)} * {value}"


def _place(controller: Controller) -> str:
    lines, size = [], len(controller.coordinates)
    if not all(lag.of_action or lag.kind == "sum" for lag in controller.lags):
        lines.append("const int known = controller->acted && controller->measured && measurement;")
    if any(lag.kind != "action" for lag in controller.lags):
        lines += [f"real before[{size}];", "int i;", f"for (i = 0; i < {size}; i++)", "    before[i] = q[i];"]
    lines.append("if (measurement) {")
    for i, one in enumerate(controller.measurements):
        value = f"measurement[{i}]"
        if one.angle:
            value = f"wrapped({value})"
        elif not (math.isinf(one.low) and math.isinf(one.high)):
            value = f"clipped({value}, {real(one.low)}, {real(one.high)})"
        lines.append(f"    q[{one.place}] = {value}; /* {plain(one.name)} */")
    lines.append("}")
    for lag in controller.lags:
        change = f"q[{lag.source}] - before[{lag.source}]"
        error = f"(q[{lag.source}] - {real(lag.set_point)}) / {real(lag.unit)}"
        value = {
            "action": f"controller->action[{lag.source}]",
            "steps": f"before[{lag.place}] + R(1.0)",
            "value": f"before[{lag.source}]",
            "change": f"wrapped({change})" if lag.angle else change,
            "sum": f"before[{lag.place}] + (measurement ? {error} : R(0.0))",
        }[lag.kind]
        begun = "controller->acted" if lag.of_action or lag.kind == "sum" else "known"
        value = f"{begun} ? {value} : {real(lag.start)}"
        if not (math.isinf(lag.low) and math.isinf(lag.high)):
            value = f"clipped({value}, {real(lag.low)}, {real(lag.high)})"
        lines.append(f"q[{lag.place}] = {value}; /* {plain(lag.name)} */")
    return _lines(4, lines)


def _network(decision: Decision) -> str:
    code = []
    for i, layer in enumerate(decision.layers):
        inputs, outputs = layer.weights.shape
        code += [
            f"static void layer{i}(const real *restrict x, real *restrict y)",
            "{",
            "    int i, k;",
            f"    for (k = 0; k < {outputs}; k++)",
            f"        y[k] = BIAS{i}[k];",
            *_products(f"WEIGHTS{i}", inputs, outputs),
        ]
        if layer.activation != "none":
            value = "squashed(y[k])" if layer.activation == "tanh" else "y[k] < 0 ? 0 : y[k]"
            code += [f"    for (k = 0; k < {outputs}; k++)", f"        y[k] = {value};"]
        code += ["}", ""]
    return "\n" + "\n".join(code)


def _products(weights: str, inputs: int, outputs: int) -> list[str]:
    """Return the C loops that add the product x @ weights to y. The first loop adds ``UNROLLED`` inputs in each pass,
    which halves the duration; the second adds the remaining inputs one by one."""
    together = inputs // UNROLLED * UNROLLED
    lines = []
    if together:
        terms = " + ".join(f"x[i + {n}] * w[k + {n * outputs}]" for n in range(UNROLLED))
        lines += [
            f"    for (i = 0; i < {together}; i += {UNROLLED}) {{",
            f"        const real *const w = {weights} + {outputs} * i;",
            f"        for (k = 0; k < {outputs}; k++)",
            f"            y[k] += {terms};",
            "    }",
        ]
    if together < inputs:
        lines += [
            f"    for (i = {together}; i < {inputs}; i++)",
            f"        for (k = 0; k < {outputs}; k++)",
            f"            y[k] += x[i] * {weights}[{outputs} * i + k];",
        ]
    return lines


def _decide(controller: Controller) -> str:
    decision, sizes = controller.decision, _sizes(controller.decision)
    standardised = "(observation[i] - MEAN[i]) / DEVIATION[i]"
    if np.isfinite(decision.clip):
        standardised = f"clipped({standardised}, {real(-decision.clip)}, {real(decision.clip)})"
    lines = [
        f"real a[{max(sizes[::2])}], b[{max(sizes[1::2])}];",
        "int i;",
        f"for (i = 0; i < {sizes[0]}; i++)",
        f"    a[i] = {standardised};",
    ]
    names = ["a" if i % 2 == 0 else "b" for i in range(len(sizes))]
    lines += [f"layer{i}({x}, {y});" for i, (x, y) in enumerate(pairwise(names))]
    y = names[-1]
    lines += [
        f"for (i = 0; i < {sizes[-1]}; i++)",
        f"    if (!({y}[i] >= -LARGEST && {y}[i] <= LARGEST))",
        "        return 0;",
    ]
    if decision.counts:
        lines[1] = "int i, k, best, first = 0;"
        lines += [
            f"for (i = 0; i < {len(decision.counts)}; i++) {{",
            "    best = first;",
            "    for (k = first + 1; k < first + CHOICES[i]; k++)",
            f"        if ({y}[k] > {y}[best])",
            "            best = k;",
            "    action[i] = LOW[i] + (real)(best - first) * (HIGH[i] - LOW[i]) / (real)(CHOICES[i] - 1);",
            "    first += CHOICES[i];",
            "}",
        ]
    else:
        shown = f"squashed({y}[i])" if decision.squash else f"{y}[i]"
        lines += [
            f"for (i = 0; i < {sizes[-1]}; i++)",
            f"    action[i] = clipped(CENTRE[i] + REACH[i] * {shown}, LOW[i], HIGH[i]);",
        ]
    return _lines(4, [*lines, "return 1;"])


def _judge(controller: Controller) -> str:
    lines = [
        f"status |= judged(measurement[{i}], {real(one.lowest)}, {real(one.highest)}); /* {plain(one.name)} */"
        for i, one in enumerate(controller.measurements)
    ]
    return _lines(4, lines)


def _in_time(controller: Controller) -> str:
    return "age >= 0" + (f" && age <= {real(controller.timeout)}" if np.isfinite(controller.timeout) else "")


def _sizes(decision: Decision) -> list[int]:
    return [len(decision.mean), *(len(layer.bias) for layer in decision.layers)]


def _lines(indent: int, lines: Iterable[str]) -> str:
    return "\n".join(" " * indent + line for line in lines)
