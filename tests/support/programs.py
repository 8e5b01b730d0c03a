"""A program that keeps the protocol of executables, and copies of it with faults."""

from __future__ import annotations

import shlex
import sys
import time
from pathlib import Path

from support.moody import SPEC

PATIENCE_SECONDS = 10.0

SOURCE = f"""
import json, os, random, sys, time

SPEC = json.loads({SPEC.model_dump_json()!r})
x = last = 0.0

def spec(request):
    return {{"protocol": 1, "spec": SPEC}}

def go(to):
    global x
    x = to
    return {{"state": [x]}}

def reset(request):
    return go(random.Random(request["seed"]).uniform(-0.5, 0.5))

def put(request):
    [to] = request["state"]
    return go(to)

def get(request):
    return {{"state": [x]}}

def save(request):
    return {{"snapshot": repr(x)}}

def restore(request):
    return go(float(request["snapshot"]))

def step(request):
    global last
    [u] = request["action"]
    before, after = x, x + 0.1 * u
    last = u
    return go(after) | {{"reward": -abs(before), "terminated": False, "truncated": False}}

def close(request):
    return {{}}

methods = {{"spec": spec, "reset": reset, "set": put, "get": get, "save": save, "restore": restore, "step": step}}
methods["close"] = close
for line in sys.stdin:
    number = method = None
    try:
        request = json.loads(line)
        number, method = request["id"], request["method"]
        if method in methods:
            answer = {{"result": methods[method](request)}}
        else:
            answer = {{"error": "unknown", "code": "unsupported"}}
    except (ValueError, LookupError, TypeError) as error:
        answer = {{"error": repr(error), "code": "invalid"}}
    print(json.dumps({{"id": number, **answer}}), flush=True)
    if method == "close":
        break
"""


NOTES_ITSELF = (
    "x = last = 0.0",
    "x = last = 0.0\nopen(os.path.dirname(__file__) + '/pids', 'a').write(f'{os.getpid()}\\n')",
)
LIMITS = """SPEC |= {"sampling_period": 0.005, "limits": {
    "keep": [{"name": "end", "high": 0.9, "margin": 0.2,
              "term": {"parts": [{"function": "linear", "weights": {"x": 1}}]}}],
    "fallback": [{"parts": [{"function": "linear", "weights": {"x": -5}}]}],
}}
"""
KEEPS_LIMITS = "x = last = 0.0\n", f"{LIMITS}x = last = 0.0\n"
FALLS_BACK = (
    "        break\n",
    """        break
else:  # the input has ended
    steps, before = 0, None
    while before is None or abs(before - x) > 1e-3:
        before, steps = x, steps + 1
        step({"action": [-5 * x]})
    print(json.dumps({"fallback": steps}), flush=True)
""",
)
HANGS = "    global last\n", "    time.sleep(3600)\n"
UNTERMINABLE = "import json", "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN)\nimport json"


def program(folder: Path, *faults: tuple[str, str]) -> str:
    """Write a copy in which each fault's first text is replaced by its second; the command that runs it."""
    source = SOURCE
    for before, after in faults:
        assert before in source
        source = source.replace(before, after)
    path = folder / f"program-{len(list(folder.glob('program-*')))}.py"
    path.write_text(source)
    return shlex.join([sys.executable, "-I", "-S", str(path)])


def left_behind(folder: Path) -> list[int]:
    """The programs of a folder that still run, of those that note themselves (``NOTES_ITSELF``). A signal takes its
    time to end one."""
    deadline = time.monotonic() + PATIENCE_SECONDS
    while True:
        left = [pid for pid in map(int, (folder / "pids").read_text().split()) if is_running(pid)]
        if not left or time.monotonic() > deadline:
            return left
        time.sleep(0.01)


def is_running(pid: int) -> bool:
    """Whether a process exists. One that has ended but was not waited for does not count."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"
