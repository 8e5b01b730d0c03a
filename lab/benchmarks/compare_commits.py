"""Compares the behaviour and the speed of two commits on this machine.

Run by ``make compare ARGS="BEFORE AFTER"``. Each commit is unpacked into a folder of its own. There it runs the demo of
each task and seed, with a short training. Then its server serves that run and is asked for what it holds and does:
queries, samples, models, predictions, trajectories. All of it has to be the same to the last bit. With ``--design`` the
design runs without a training, for commits whose policies differ on purpose: in a demo the states that a policy visits
lead to further queries.

Nothing but commands and requests is used, so a commit may move its modules. Steps, predictions and fits are timed on
the runs of the first seed; the two servers take turns.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import reprlib
import statistics
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import httpx
import numpy as np
import torch
from common import OUT, Call, Turns, ratio, take_turns, timed, write
from pydantic import TypeAdapter
from safetensors.torch import load

from support.server import COLD, ServerProcess, start_server
from surrogym.demo.tasks import TASKS
from surrogym_client.environments.spaces import space
from surrogym_shared.wire import ActionSpace

COMPARED = ("pendulum", "cartpole", "swingup", "mountaincar", "acrobot", "invertedpendulum")
SEEDS = (0, 1)
TRAINING_STEPS, EPISODES = 8_192, 2
POINTS, LANES, STEPS = 64, 4, 200  # of a comparison
ROUNDS, CALLS, FITS = 20, 10, 30  # of a timing
PATIENCE = 600.0  # seconds for a reply: a commit whose steps were never compiled here compiles them first
SHOWN = 8  # differences of a run
POINT_ROUTES = ("predict", "query_uncertainty")
VARIANTS: dict[str, dict[str, Any]] = {
    "deterministic": {},
    "probabilistic": {"variant": "probabilistic", "particles": 20, "start_box": 0.5},
    "pathwise": {"variant": "pathwise", "penalty": 1.0},
}
OF_A_SAMPLE = ("coordinates", "action", "next_coordinates", "reward", "terminated", "observation", "next_observation")
PACKAGES = ("front", "server", "client", "shared")  # older commits have a folder front
OF_ONE_RUN = {
    "created_at",
    "fit_seconds",
    "sampler",
    "seconds",
    "commit",
    "versions",
    "out",
    "machine",
    "tensorboard",
    "tensorboard_log",
}  # not compared

Facts = dict[str, Any]


@dataclass(frozen=True)
class Commit:
    """An unpacked commit."""

    folder: Path

    @property
    def path(self) -> str:
        return os.pathsep.join(str(self.folder / package) for package in PACKAGES)

    @property
    def program(self) -> str:
        """Package that is the command: older commits have it in the client."""
        return "surrogym" if (self.folder / "client/surrogym/__main__.py").exists() else "surrogym_client"

    def demo(self, task: str, seed: int, run: Path) -> None:
        """Run the demo of a task with a short training."""
        sizes = ["--steps", str(TRAINING_STEPS), "--episodes", str(EPISODES), "--no-pictures", "--quiet"]
        self._run("demo", task, "--seed", str(seed), "--out", str(run), *sizes)

    def design(self, task: str, seed: int, run: Path) -> None:
        """Run the design of a task alone: a server in the folder ``run``, and a sampler."""
        run.mkdir(parents=True)
        environment, budget = TASKS[task].environment, TASKS[task].budget
        with self.server(run) as server:
            about = ["--name", task, "--budget", str(budget), "--seed", str(seed)]
            self._run("register", environment, *about, "--server", server.url, "--quiet")
            self._run("sample", task, "--env", environment, "--until-done", "--server", server.url, "--quiet")

    @contextmanager
    def server(self, run: Path) -> Iterator[ServerProcess]:
        """The server of this commit on the run in a folder; a fork of this process would run other code."""
        server = start_server(run, program=COLD, PYTHONPATH=self.path)
        try:
            yield server
        finally:
            server.stop()

    def _run(self, *arguments: str) -> None:
        command, environment = [sys.executable, "-m", self.program, *arguments], os.environ | {"PYTHONPATH": self.path}
        subprocess.run(command, cwd=self.folder, env=environment, check=True, stdout=subprocess.DEVNULL)


def unpacked(revision: str, folder: Path) -> Commit:
    """A commit of this repository in a folder."""
    folder.mkdir()
    archive = subprocess.run(["git", "archive", revision], capture_output=True, check=True).stdout
    subprocess.run(["tar", "--extract", "--directory", str(folder)], input=archive, check=True)
    return Commit(folder)


class Server:
    """A server of either commit, spoken to without the client, whose older and newer replies need not fit."""

    def __init__(self, url: str) -> None:
        self._http = httpx.Client(base_url=url, timeout=PATIENCE)
        [surrogate] = self.get("/v1/surrogates")["surrogates"]
        self.surrogate = f"/v1/surrogates/{surrogate['name']}"

    def get(self, path: str) -> Any:
        return self._http.get(path).raise_for_status().json()

    def post(self, path: str, body: Facts) -> Any:
        reply = self._http.post(path, json=body)
        if reply.is_error:
            raise RuntimeError(f"expected an answer to {path}, got {reply.text}")
        return reply.json()

    def content(self, path: str) -> bytes:
        return self._http.get(path).raise_for_status().content

    def close(self) -> None:
        self._http.close()

    def newest_model(self) -> Facts:
        return cast("Facts", self.get(f"{self.surrogate}/models")["models"][-1])

    def points(self) -> Facts:
        """Points that were sampled, in a seeded order; they are valid in any environment."""
        samples = self.get(f"{self.surrogate}/samples")["samples"]
        chosen = np.random.default_rng(0).choice(len(samples), (2, POINTS))
        return {
            "coordinates": [samples[i]["coordinates"] for i in chosen[0]],
            "action": [samples[i]["action"] for i in chosen[1]],
        }


class Session:
    """A session that takes the same seeded random actions on every server."""

    def __init__(self, server: Server, lanes: int, **options: Any) -> None:
        self._server = server
        opened = server.post(f"{server.surrogate}/sessions", {"num_envs": lanes, "seed": 0, **options})
        self._path, self._lanes, self._seq = f"/v1/sessions/{opened['id']}", lanes, 1
        self._space = space(TypeAdapter(ActionSpace).validate_python(opened["action_space"]))
        self._space.seed(0)
        server.post(f"{self._path}/reset", {"seq": self._seq, "seed": 0})

    def rollout(self, steps: int) -> Any:
        """The reply to so many steps of all lanes, in one request."""
        self._seq += 1
        actions = [[self._space.sample().tolist() for _ in range(self._lanes)] for _ in range(steps)]
        return self._server.post(f"{self._path}/rollout", {"seq": self._seq, "actions": actions})


def facts(server: Server, run: Path) -> Facts:
    """Everything that a run holds and that its server does, by name."""
    version = server.newest_model()["version"]
    arrays = load(server.content(f"{server.surrogate}/models/{version}?format=safetensors"))
    found: Facts = {
        **{room: server.get(f"{server.surrogate}/{room}") for room in ("queries", "samples", "models")},
        "arrays": {name: _digest(array.numpy()) for name, array in arrays.items()},
        **_trained(run),
        **{route: server.post(f"{server.surrogate}/{route}", server.points()) for route in POINT_ROUTES},
        **{f"trajectory, {name}": Session(server, LANES, **o).rollout(STEPS) for name, o in VARIANTS.items()},
    }
    return {what: _without(value) for what, value in found.items()}


def _trained(run: Path) -> Facts:
    """Metrics and policy of a demo; none of a design without a training."""
    if not (run / "policy.zip").exists():
        return {}
    return {"metrics": json.loads((run / "metrics.json").read_text()), "policy": _policy(run / "policy.zip")}


def _without(value: Any) -> Any:
    """A value without the fields that differ from run to run."""
    if isinstance(value, Mapping):
        return {name: _without(one) for name, one in value.items() if name not in OF_ONE_RUN}
    return [_without(one) for one in value] if isinstance(value, list) else value


def _policy(file: Path) -> dict[str, str]:
    """Digests of a policy's arrays; the file around them holds times and versions."""
    with zipfile.ZipFile(file) as archive:
        if "policy.pth" not in archive.namelist():
            return {name: hashlib.sha256(archive.read(name)).hexdigest() for name in archive.namelist()}
        with archive.open("policy.pth") as weights:
            return {name: _digest(array.numpy()) for name, array in torch.load(weights, weights_only=True).items()}


def _digest(array: np.ndarray[Any, Any]) -> str:
    return f"{array.dtype} {array.shape} {hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:16]}"


def differences(before: Any, after: Any, where: str = "") -> Iterator[str]:
    """The places at which two facts differ, with what stands there."""
    if isinstance(before, Mapping) and isinstance(after, Mapping):
        for name in dict.fromkeys([*before, *after]):
            yield from differences(before.get(name), after.get(name), f"{where}.{name}" if where else str(name))
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for index, pair in enumerate(zip(before, after, strict=True)):
            yield from differences(*pair, f"{where}[{index}]")
    elif before != after:
        yield f"{where}: {reprlib.repr(before)} became {reprlib.repr(after)}"


def timings(servers: Mapping[str, Server], rounds: int) -> Facts:
    """Median seconds of rollouts, predictions and fits of both commits, and the ratio of after to before."""
    before = servers["before"]
    measured: Facts = {}
    for lanes, steps in ((1, 200), (64, 20)):
        sessions = {side: Session(server, lanes) for side, server in servers.items()}
        calls: dict[str, Call] = {side: partial(session.rollout, steps) for side, session in sessions.items()}
        measured[f"{steps} steps of {lanes} lanes"] = _row(_turns(calls, rounds))
    path, points = f"{before.surrogate}/predict", before.points()
    calls = {side: partial(server.post, path, points) for side, server in servers.items()}
    return measured | {f"prediction of {POINTS} points": _row(_turns(calls, rounds)), "fit": _row(_fits(servers))}


def _turns(calls: Mapping[str, Call], rounds: int) -> Turns:
    return take_turns({side: timed(call) for side, call in calls.items()}, rounds, CALLS, CALLS)


def _fits(servers: Mapping[str, Server]) -> Turns:
    """Seconds of fits, one after each sample that is added by hand. The servers take turns at being first. The first
    fit of a server compiles, and is left out."""
    taken: Turns = {side: [] for side in servers}
    for number in range(FITS + 1):
        for side in sorted(servers, reverse=number % 2 == 1):
            seconds = _fit(servers[side], number)
            if number > 0:
                taken[side].append([seconds])
    return taken


def _fit(server: Server, number: int) -> float:
    samples = server.get(f"{server.surrogate}/samples")["samples"]
    sample = samples[number % len(samples)]
    version = server.newest_model()["version"]
    again = {field: sample[field] for field in OF_A_SAMPLE if field in sample}
    body = {"sampler": "comparison", "samples": [again], "idempotency_key": f"fit {number}"}
    server.post(f"{server.surrogate}/add_sample", body)
    while (model := server.newest_model())["version"] == version:
        time.sleep(0.25)
    return float(model["fit_seconds"])


def _row(turns: Turns) -> dict[str, float]:
    medians = {side: statistics.median(one for taken in rounds for one in taken) for side, rounds in turns.items()}
    return medians | {"ratio": ratio(turns["after"], turns["before"])}


def main() -> None:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("before", help="a commit")
    made.add_argument("after", nargs="?", default="HEAD", help="another one; default: HEAD")
    made.add_argument("--tasks", nargs="+", default=COMPARED, help="names of the demo's tasks")
    made.add_argument("--seeds", nargs="+", type=int, default=SEEDS)
    made.add_argument("--design", action="store_true", help="compare designs without a training")
    made.add_argument("--rounds", type=int, default=ROUNDS, help="turns of a timing; 0 leaves the timings out")
    made.add_argument("--out", type=Path, default=OUT, help="folder of the JSON file")
    options = made.parse_args()
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    with tempfile.TemporaryDirectory(prefix="surrogym-compare-") as folder:
        rows = compared(options, Path(folder))
    write(options.out, "compare_commits", {"before": options.before, "after": options.after, "runs": rows})
    differing = sum(bool(row["differences"]) for row in rows)
    print(f"{len(rows) - differing} of {len(rows)} runs are the same to the last bit")
    sys.exit(1 if differing else 0)


def compared(options: argparse.Namespace, folder: Path) -> list[Facts]:
    """A row for each task and seed: the differences, and for the first seed the timings."""
    commits = {side: unpacked(getattr(options, side), folder / side) for side in ("before", "after")}
    rows = []
    for task in options.tasks:
        for seed in options.seeds:
            rounds = options.rounds if seed == options.seeds[0] else 0
            make = partial(Commit.design if options.design else Commit.demo, task=task, seed=seed)
            row = compared_run(commits, make, rounds, folder / f"{task}-{seed}")
            rows.append({"task": task, "seed": seed, **row})
            print(f"{task}, seed {seed}: {len(row['differences'])} differences")
            for line in row["differences"][:SHOWN]:
                print(f"  {line}")
            for what, figures in row["timings"].items():
                print(f"  {what}: after over before {figures['ratio']:.3f}")
    return rows


def compared_run(commits: Mapping[str, Commit], make: Callable[..., None], rounds: int, folder: Path) -> Facts:
    """The differences of one run of both commits, and timings if there are rounds of them.

    ``make`` makes the run of a commit in the folder ``run``.
    """
    with ExitStack() as stack:
        servers, found = {}, {}
        for side, commit in commits.items():
            run = folder / side
            make(commit, run=run)
            url = stack.enter_context(commit.server(run)).url
            servers[side] = stack.enter_context(closing(Server(url)))
            found[side] = facts(servers[side], run)
        told = list(differences(found["before"], found["after"]))
        return {"differences": told, "timings": timings(servers, rounds) if rounds else {}}


if __name__ == "__main__":
    main()
