"""The executable's protocol (docs/how-to/executables.md) around a machine, and its specification.

The specification names only what the sensors read: neither speeds, nor dead time, nor friction.
"""

import argparse
import json
import math
import sys


def term(function, name, weight=1):
    return {"parts": [{"function": function, "coefficient": 1, "weights": {name: weight}}]}


def coordinate(name, unit, low, high, start, kind="linear"):
    """Return a coordinate of a specification with the range of its starts: both are read by ``specification``."""
    return {"name": name, "unit": unit, "kind": kind, "sampling": {"kind": "uniform", "low": low, "high": high}}, start


def angle(name, start):
    return coordinate(name, "rad", -math.pi, math.pi, start, kind="angle")


def specification(machine, coordinates):
    """Return the specification of a machine: coordinates as above, and one that ends the episode beyond its range."""
    observation, termination = [], []
    for c, _ in coordinates:
        if c["kind"] == "angle":
            observation += [{"name": f"{f} {c['name']}", "term": term(f, c["name"])} for f in ("cos", "sin")]
        else:
            observation.append({"name": c["name"], "term": term("linear", c["name"])})
            for relation, end in ((">", "high"), ("<", "low")):
                value = c["sampling"][end]
                termination.append([{"term": term("linear", c["name"]), "relation": relation, "value": value}])
    return {
        "environment": machine.name,
        "coordinates": [c for c, _ in coordinates],
        "observation": observation,
        "action": {"kind": "box", "low": [-machine.largest], "high": [machine.largest]},
        "start": {c["name"]: {"kind": "uniform", "low": low, "high": high} for c, (low, high) in coordinates},
        "termination": termination,
        "time_limit": round(machine.seconds / machine.period),
        "sampling_period": machine.period,
        "query": "rollout",
        "reward": {"kind": "learned", "timing": "after"},
        "success": {"hold": [{"term": t, "relation": ">", "value": 0.95} for t in machine.upright], "hold_steps": 20},
    }


class Invalid(Exception):
    """A request lacks a field, or has a wrong one."""


class Program:
    """Answers requests for one machine, a ``Machine`` with ``spec``, ``reward`` and ``ended`` of what was measured."""

    def __init__(self, machine):
        self.machine, self.running = machine, False

    def spec(self, request):
        return {"protocol": 1, "spec": self.machine.spec()}

    def reset(self, request):
        seed = request.get("seed")
        if seed is not None and (type(seed) is not int or seed < 0):
            raise Invalid(f"expected a whole number from 0 on, or null, for seed, got {seed!r}")
        self.running = True
        return {"state": self.machine.reset(seed).tolist()}

    def step(self, request):
        action = request.get("action")
        numbers = isinstance(action, list) and all(type(u) in (int, float) and math.isfinite(u) for u in action)
        if not numbers or len(action) != 1:
            raise Invalid(f"expected one finite number for action, got {action!r}")
        if not self.running:
            raise RuntimeError("expected a reset before a step, got a step")
        read = self.machine.step(float(action[0]))
        ended = bool(self.machine.ended(read))
        self.running = not ended
        return {"state": read.tolist(), "reward": self.machine.reward(read), "terminated": ended, "truncated": False}

    def close(self, request):
        return {}

    def answer(self, line):
        """Return the answer to a line, and whether it was the last one."""
        try:
            request = json.loads(line)
        except ValueError:
            request = None
        if not isinstance(request, dict):
            return {"id": None, "error": "expected a request, got another line", "code": "invalid"}, False
        number, method = request.get("id"), request.get("method")
        if method not in ("spec", "reset", "step", "close"):
            said = f"expected spec, reset, step or close, got {method!r}"
            return {"id": number, "error": said, "code": "unsupported"}, False
        try:
            return {"id": number, "result": getattr(self, method)(request)}, method == "close"
        except Invalid as error:
            return {"id": number, "error": str(error), "code": "invalid"}, False
        except Exception as error:  # the program must keep running
            return {"id": number, "error": str(error), "code": "failed"}, False


def main(kind):
    """Run the program of a kind of machine, which is made with ``seed`` and ``clean``."""
    parser = argparse.ArgumentParser(description=sys.modules["__main__"].__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="draws the parameters of the machine")
    parser.add_argument("--clean", action="store_true", help="without dead time, friction, limits, noise and encoders")
    options = parser.parse_args()
    serve(kind(options.seed, options.clean))


def serve(machine):
    """Answer the requests of standard input for a machine."""
    program = Program(machine)
    for line in sys.stdin:
        answer, last = program.answer(line)
        print(json.dumps(answer), flush=True)
        if last:
            break
