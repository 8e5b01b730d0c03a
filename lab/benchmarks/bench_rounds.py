"""Rounds of real episodes on a larger system: train, run episodes, learn from each of their steps, train on.

A real server, and the commands that a user would type. Each round prints one line. The means of a round are those of
its own episodes, which nothing was learned from before. The real steps are all that were taken, those of the
description among them. In the end, the policy of the round with the largest mean is measured from other starts.

    python lab/benchmarks/bench_rounds.py Hopper-v5 --seed 1 --initial 1000 --each 1000 --budget 10000
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench_start import COMMAND, serving
from common import started

from surrogym_lab.reproduce.rows import read_records, write_records
from surrogym_shared.words import counted

NAME = "task"
MOST_EPISODES = 50  # of a round
WAIT = 1_800  # seconds for a model


@dataclass(frozen=True)
class Round:
    """One round: its policy's imagined return and promise, and its real episodes."""

    round: int
    real_steps: int  # before its episodes
    imagined: float
    low: float
    high: float
    trusted: bool
    episodes: int
    mean: float
    least: float
    best: float
    length: float
    training_seconds: float
    round_seconds: float


def main() -> None:
    options = _options()
    options.out.mkdir(parents=True, exist_ok=True)
    with serving(options.out) as url:
        os.environ["SURROGYM_URL"] = url
        rounds = read_records(options.out / "rounds.csv", Round) if options.resume else []
        real = _after(rounds[-1]) if rounds else _begun(options)
        while real + options.each <= options.budget:
            rounds.append(_round(options, len(rounds) + 1, real, rounds[-1].length if rounds else None))
            real = _after(rounds[-1])
            write_records(options.out / "rounds.csv", Round, rounds)
        kept = max(rounds, key=lambda found: found.mean).round
        arguments = [str(_policy(options, kept)), "--env", options.environment, "--first-seed", "50000"]
        whole = ["--spec", str(options.out / "whole.json"), "--episodes", str(options.judge)]
        judged = _run("evaluate", *arguments, *whole, "--compare", "zero")
        (options.out / "judged.json").write_text(json.dumps(judged, indent=1))
        mean, least, best = (judged[name] for name in ("mean", "min", "max"))
        print(
            f"after {real:,} real steps: policy of round {kept}, mean {mean:.1f} of {options.judge} starts "
            f"({least:.1f} to {best:.1f})"
        )


def _options() -> argparse.Namespace:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("environment", help="name of the environment")
    made.add_argument("--spec", type=Path, help="description as surrogym describe writes it. Default: describe first")
    made.add_argument("--model", default="sparse_gaussian_process", help="family of models")
    made.add_argument("--settings", type=json.loads, default={}, help="of the family, as JSON")
    made.add_argument("--access", choices=["reset", "any"], default="reset", help="of the first real steps")
    made.add_argument("--seed", type=int, default=0)
    made.add_argument("--initial", type=int, default=1_000, help="real steps before the first round")
    made.add_argument("--rollout", type=int, default=100, help="actions of each random episode of these, at most")
    made.add_argument("--each", type=int, default=1_000, help="real steps of a round, about")
    made.add_argument(
        "--budget", type=int, default=10_000, help="real steps, about. A round begins while it has room for --each"
    )
    made.add_argument("--longest", type=int, help="steps of a real episode of a round. Default: as declared")
    made.add_argument("--explore", type=float, default=0.0, help="random share of the actions of these episodes")
    made.add_argument("--steps", type=int, default=300_000, help="virtual steps of each training")
    made.add_argument("--train", default="", help="further options of surrogym train, in one word")
    made.add_argument(
        "--judge", type=int, default=20, help="real episodes of the policy that is kept. Nothing is learned from them"
    )
    made.add_argument("--resume", action="store_true", help="continue the interrupted run in --out")
    made.add_argument("--out", type=Path, default=Path("build/rounds"), help="folder, of one run")
    return started(made)


def _begun(options: argparse.Namespace) -> int:
    """Register the environment, and take the real steps before the first round. Returns how many there are by then."""
    spec, described = _described(options)
    register = [NAME, "--env", options.environment, "--spec", str(spec), "--access", options.access]
    budget = ["--budget", str(options.initial), "--initial", str(options.initial), "--seed", str(options.seed)]
    rollout = [] if options.access == "any" else ["--max-rollout", str(options.rollout)]
    _run("register", *register, *budget, *rollout)
    _run("sample", NAME, "--env", options.environment, "--until-done", as_json=False)
    return described + int(options.initial)


def _after(found: Round) -> int:
    return found.real_steps + round(found.episodes * found.length)


def _described(options: argparse.Namespace) -> tuple[Path, int]:
    """The file to register, and the real steps of its description."""
    if options.spec is None:
        found = subprocess.run(
            [*COMMAND, "describe", options.environment, "--seed", str(options.seed)], stdout=subprocess.PIPE, check=True
        ).stdout
    else:
        found = options.spec.read_bytes()
    described: dict[str, Any] = json.loads(found)
    (options.out / "whole.json").write_text(json.dumps(described))
    described["specification"]["design"]["model"] = {"name": options.model, "settings": options.settings}
    if options.longest is not None:
        described["specification"]["time_limit"] = options.longest
    file: Path = options.out / "env.json"
    file.write_text(json.dumps(described, indent=1))
    return file, int(described["real_steps"])


def _round(options: argparse.Namespace, number: int, real: int, length: float | None) -> Round:
    began = time.monotonic()
    trained = _train(options, number)
    episodes = 1 if length is None else max(1, min(MOST_EPISODES, round(options.each / length)))
    arguments = [str(_policy(options, number)), "--env", options.environment, "--spec", str(options.out / "env.json")]
    seeds = ["--episodes", str(episodes), "--first-seed", str(1_000 * options.seed + MOST_EPISODES * number)]
    done = _run("evaluate", *arguments, *seeds, "--explore", str(options.explore), "--learn-all", "--wait", str(WAIT))
    promise = trained["promise"]
    found = Round(
        *(number, real, trained["imagined_return"], promise["low"], promise["high"], trained["trusted"], episodes),
        *(done["mean"], done["min"], done["max"], done["mean_length"], trained["seconds"], time.monotonic() - began),
    )
    print(
        f"round {number}: {real:,} real steps, imagined {found.imagined:.1f} ({found.low:.1f} to {found.high:.1f}), "
        f"real {found.mean:.1f} ({found.least:.1f} to {found.best:.1f}, {counted(episodes, 'episode')} of "
        f"{found.length:.0f} steps), training {found.training_seconds:.0f} s, round {found.round_seconds:.0f} s"
    )
    return found


def _train(options: argparse.Namespace, number: int) -> dict[str, Any]:
    before = ["--start-from", str(_policy(options, number - 1))] if number > 1 else []
    arguments = [NAME, "--seed", str(1_000 * options.seed + number), "--steps", str(options.steps), "--no-audit"]
    arguments += ["--out", str(_policy(options, number))]
    return _run("train", *arguments, *before, *options.train.split(), "--wait", str(WAIT))


def _policy(options: argparse.Namespace, number: int) -> Path:
    return Path(options.out, f"policy-{number}.zip")


def _run(command: str, *arguments: str, as_json: bool = True) -> dict[str, Any]:
    """Run a command of surrogym, and return its JSON."""
    given = [*COMMAND, command, *arguments, "--quiet", *(["--json"] if as_json else [])]
    done = subprocess.run(given, stdout=subprocess.PIPE, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(given)} ended with {done.returncode}")
    return dict(json.loads(done.stdout)) if as_json else {}


if __name__ == "__main__":
    sys.exit(main())
