"""Seconds of each phase of a whole demo, from cold to the evaluated policy, of two commits in turns.

Phases: start of the server, design, training without its checks, checks of the imagined return, evaluation. ``cpu`` are
the processor seconds of all programs of the demo, which other programs on the machine hardly change. Nothing but
commands and run folders is used, so a commit may move its modules. Run by ``make bench ARGS="--parts phases"``; it
takes an hour on free cores, so ``make bench`` alone leaves it out.
"""

from __future__ import annotations

import json
import os
import resource
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from common import parser, started, write
from compare_commits import Commit, unpacked

BEFORE, AFTER = "f7caf9c", "HEAD"  # the commit before PPO in NumPy
TASKS = ("pendulum", "cartpole", "swingup", "acrobot", "doublependulum", "reacher")
CHECKS = 12  # in the steps that a training was planned to take
PHASES = ("start", "design", "train", "checks", "evaluate", "total", "cpu")


def demo(commit: Commit, task: str, seed: int, out: Path, further: Sequence[str]) -> dict[str, Any]:
    """Seconds of the phases of a whole demo, and what it came to."""
    command = [sys.executable, "-m", commit.program, "demo", task, "--seed", str(seed), "--out", str(out)]
    environment, before = os.environ | {"PYTHONPATH": commit.path}, cpu_of_children()
    subprocess.run(
        [*command, "--no-pictures", "--quiet", *further],
        cwd=commit.folder,
        env=environment,
        check=True,
        stdout=subprocess.DEVNULL,
    )
    metrics = json.loads((out / "metrics.json").read_text())
    lines = [json.loads(line) for line in (out / "training.jsonl").read_text().splitlines()]
    seconds = dict(metrics["seconds"])
    seconds["checks"] = seconds_of_checks(lines)
    seconds["train"] -= seconds["checks"]
    seconds["cpu"] = cpu_of_children() - before
    steps = metrics["virtual_steps"]
    return {"seconds": seconds, "real": metrics["real_return"]["mean"], "reached": metrics["reached"], "steps": steps}


def cpu_of_children() -> float:
    """Processor seconds of all child processes that have ended, and of theirs."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def seconds_of_checks(lines: Sequence[Mapping[str, Any]]) -> float:
    """What rollouts that end with a check take longer than the others, by the progress of a training."""
    planned, checked, with_check, without = 0, 0, [], []
    for before, now in pairwise(lines):
        if now["steps"] < before["steps"] or not planned:  # another training begins
            planned, checked = now["total_steps"], 0
        taken, due = now["seconds"] - before["seconds"], now["steps"] * CHECKS // planned
        (with_check if due > checked else without).append(taken)
        checked = max(due, checked)
    if not with_check or not without:
        return 0.0
    usual = statistics.median(without)
    return sum(max(taken - usual, 0.0) for taken in with_check)


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--before", default=BEFORE, help="a commit; default: the one before PPO in NumPy")
    made.add_argument("--after", default=AFTER, help="another one; default: HEAD")
    made.add_argument("--tasks", nargs="+", default=TASKS)
    made.add_argument("--seeds", nargs="+", type=int, default=(0,))
    made.add_argument("--algorithm", default="fastppo", help="of the later commit; the earlier one has its default")
    options = started(made)
    rows: list[dict[str, Any]] = []
    with TemporaryDirectory(prefix="surrogym-phases-") as name:
        folder = Path(name)
        sides = {
            "before": (unpacked(options.before, folder / "before"), []),
            "after": (unpacked(options.after, folder / "after"), ["--algorithm", options.algorithm]),
        }
        for task in TASKS[:1] if options.quick else options.tasks:
            for seed in options.seeds:
                for side, (commit, further) in sides.items():
                    found = demo(commit, task, seed, folder / f"{task}-{seed}-{side}", further)
                    rows.append({"task": task, "seed": seed, "side": side, **found})
                    taken = ", ".join(f"{phase} {found['seconds'][phase]:.1f}" for phase in PHASES)
                    taken += f"; {found['steps']:,} virtual steps"
                    print(f"{task}, seed {seed}, {side}: {taken}; real {found['real']:.1f}")
    write(options.out, "phases", {"before": options.before, "after": options.after, "runs": rows})


if __name__ == "__main__":
    main()
