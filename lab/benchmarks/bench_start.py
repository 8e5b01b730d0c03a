"""Seconds until something happens: help, a served page, the first virtual step, the demo's first real step.

Each is measured from the start of a fresh process; the first round, which may compile, is left out. Run by ``make
bench``.
"""

from __future__ import annotations

import sqlite3
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import httpx
from common import parser, started, write

from support.teaching import teach
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_sampler.original.classic import pendulum
from surrogym_shared.wire import OpenSession

COMMAND = [sys.executable, "-m", "surrogym"]
SAMPLES, LONGEST = 24, 60.0
GOALS = {"help": 0.3, "page": 2.0, "first virtual step": 1.0, "demo's first real step": 3.0}


def help_shown() -> float:
    """Until ``surrogym --help`` has ended."""
    start = time.perf_counter()
    subprocess.run([*COMMAND, "--help"], stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - start


@contextmanager
def serving(folder: Path) -> Iterator[str]:
    """The address of a server on the database of a folder."""
    ready = folder / "ready"
    ready.unlink(missing_ok=True)
    options = ["--port", "0", "--database", str(folder / "db"), "--ready-file", str(ready), "--log-level", "warning"]
    child = subprocess.Popen([*COMMAND, "serve", "--quiet", *options])
    try:
        until = time.monotonic() + LONGEST
        while not ready.exists():
            if child.poll() is not None or time.monotonic() > until:
                raise SystemExit("the server did not start")
            time.sleep(0.005)
        yield ready.read_text()
    finally:
        child.terminate()
        child.wait()


def page_shown() -> float:
    """Until a new server has answered with its page, on a new database."""
    with TemporaryDirectory() as folder:
        start = time.perf_counter()
        with serving(Path(folder)) as url:
            httpx.get(url, follow_redirects=True).raise_for_status()
            return time.perf_counter() - start


def first_virtual_step(folder: Path) -> float:
    """From opening a session, the first of its server, until its first step."""
    with serving(folder) as url, HttpSurrogate(url, "pendulum") as surrogate:
        surrogate.spec()
        time.sleep(1)
        start = time.perf_counter()
        session = surrogate.open(OpenSession(num_envs=1, seed=0))
        surrogate.reset(session.id)
        surrogate.step(session.id, [[0.0]])
        return time.perf_counter() - start


def demos_first_real_step() -> float:
    """From the start of a demo until its sampler claims the first query, which it answers within a millisecond."""
    with TemporaryDirectory() as folder:
        out = Path(folder, "run")
        options = ["pendulum", "--out", str(out), "--steps", "8192", "--episodes", "1", "--no-pictures", "--quiet"]
        start = time.time()
        subprocess.run([*COMMAND, "demo", *options], stdout=subprocess.DEVNULL, check=True)
        with closing(sqlite3.connect(out / "surrogym.db")) as database:
            [(first,)] = database.execute("SELECT min(begun) FROM leases")
        return float(first) - start


def main() -> None:
    options = started(parser(__doc__))
    with TemporaryDirectory() as folder:
        with serving(Path(folder)) as url, Api(url) as api:
            teach(api, "pendulum", pendulum(), queries=SAMPLES)
        subjects: dict[str, Callable[[], float]] = {
            "help": help_shown,
            "page": page_shown,
            "first virtual step": lambda: first_virtual_step(Path(folder)),
            "demo's first real step": demos_first_real_step,
        }
        taken: dict[str, list[float]] = {name: [] for name in subjects}
        for number in range(2 if options.quick else 6):
            for name, subject in subjects.items():
                seconds = subject()
                if number:
                    taken[name].append(seconds)
    report: dict[str, Any] = {}
    for name, seconds in taken.items():
        report[name] = {"seconds": statistics.median(seconds), "all": seconds, "goal": GOALS[name]}
        print(f"{name}: {report[name]['seconds']:.2f} s, goal {GOALS[name]} s")
    write(options.out, "start", {"subjects": report})


if __name__ == "__main__":
    main()
