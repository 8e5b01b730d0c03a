"""Learning by three processes: a server, a sampler and a trainer."""

from __future__ import annotations

import json
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any
from uuid import uuid4

from surrogym.demo.judging import Judgement
from surrogym.demo.processes import Child, Children, await_file, free_port
from surrogym.demo.settings import DemoSettings
from surrogym_client.surrogates.waiting import share_of_design, wait_for_design, words_of_design
from surrogym_client.transport.api import Api
from surrogym_client.transport.connection import Retries
from surrogym_shared.terminal import progress, say
from surrogym_shared.wire import SurrogateView
from surrogym_trainer.evaluation.reporting import as_reported, paired_start
from surrogym_trainer.policies import pushing
from surrogym_trainer.policies.card import read_card
from surrogym_trainer.training.search import ALGORITHMS
from surrogym_trainer.training.settings import ProgressEstimate
from surrogym_trainer.training.words import words_of

LEDGER = ("initial", "adaptive", "total", "unresolved", "audit")
PATIENCE_SECONDS = 3_600.0
REPORT = "report.html"  # name of the report in the run folder
LOOK_SECONDS = 1.0  # time between polls of the server, each of which slows the training a little


@dataclass(frozen=True)
class Learned:
    """A trained policy, with the real steps and the time that it took.

    Attributes:
        policy: file of the policy.
        real_queries: numbers of real steps by kind: initial, adaptive, total, unresolved, and of audits.
        seconds: duration of each phase, by the phase's name.
        confidence_index, fidelity, phase: state of the surrogate; None for a policy trained without a surrogate.
    """

    policy: Path
    real_queries: dict[str, int]
    seconds: dict[str, float]
    confidence_index: float | None = None
    fidelity: dict[str, Any] | None = None
    phase: str | None = None


class SurrogateRun:
    """A run of the demo with three processes: a server, a sampler and a trainer."""

    def __init__(self, settings: DemoSettings, folder: Path, children: Children, *, quiet: bool) -> None:
        self._settings = settings
        self._folder = folder
        self._children = children
        self._quiet = quiet
        self._seconds: dict[str, float] = {}
        self._url = f"http://127.0.0.1:{free_port()}"
        with self._timed("start"):
            self._start()
            self._api = Api(self._url, token="", retries=Retries(seconds=10.0))

    def learn(self) -> Learned:
        """Run the design and the training. The trainer starts early, so that it imports its packages during the
        design."""
        self._register()
        trainer = self._employ_trainer()
        with self._timed("design"):
            self._design()
        with self._timed("train"):
            self._train(trainer)
        return self._learned()

    def _learned(self) -> Learned:
        view = self._api.surrogate(self._settings.task)
        ledger, fidelity = view.ledger, view.fidelity
        return Learned(
            policy=self._policy,
            real_queries={name: getattr(ledger, name) for name in LEDGER},
            seconds=self._seconds,
            confidence_index=None if fidelity is None else fidelity.confidence_index,
            fidelity=None if fidelity is None else fidelity.model_dump(mode="json"),
            phase=view.phase,
        )

    def keep(self, judgement: Judgement) -> None:
        """Report the evaluation's real steps, store its episodes with the policy on the server, and write
        specification, samples and, if requested, pictures into the run folder."""
        name = self._settings.task
        self._api.report_steps(name, judgement.steps, episodes=judgement.episodes, note="demo")
        compared = min(part.settings.episodes for part in judgement.parts)
        paired = paired_start(judgement.real.result, compared)
        for part in judgement.parts:
            noted = as_reported(part.result, part.settings, uuid4().hex, controller=part.controller, paired=paired)
            pushing.keep(self._policy, noted)
        pushing.push(self._api, self._policy, name)
        view = self._api.surrogate(name)
        for file_format in ("csv", "npz"):
            content = self._api.export_samples(name, file_format)
            (self._folder / f"samples.{file_format}").write_bytes(content)
        (self._folder / "spec.json").write_text(view.spec.model_dump_json(indent=2) + "\n", encoding="utf-8")
        if self._settings.pictures:
            from surrogym.demo.pictures import draw_all

            self._write_report(name)
            draw_all(self._folder, view, list(self._api.samples(name)), read_curve(self._curve), judgement.real.result)

    def _write_report(self, name: str) -> None:
        from surrogym_trainer.report.known import collect, cuts_of
        from surrogym_trainer.report.page import page, write

        known = collect(self._api, name)
        write(self._folder / REPORT, page(known, cuts_of(self._api, known)[0]))

    def linger(self) -> None:
        """Leave the server running until Ctrl-C."""
        say(f"the server stays at {self._api.url} until Ctrl-C")
        with suppress(KeyboardInterrupt):
            while True:
                time.sleep(3_600)

    def _start(self) -> None:
        """Start the server and, so that both import their packages at once, the sampler, and wait for the server."""
        say("starting server, sampler and trainer", quiet=self._quiet)
        ready, database = self._folder / "server.url", self._folder / "surrogym.db"
        port = self._url.rpartition(":")[2]
        options = ["--port", port, "--database", str(database), "--ready-file", str(ready), "--log-level", "warning"]
        server = self._children.start("server", "surrogym_server", ["serve", *options])
        named = self._settings.demo_task.environment
        # a sampler imports a user's module only if --env names the module
        own = ["--env", named] if ":" in named else []
        self._children.start("sampler", "surrogym", ["sample", *self._common, *own])
        await_file(server, ready)

    def _register(self) -> None:
        say(f"live server, with a page to look at: {self._api.url}  (run folder: {self._folder})", quiet=self._quiet)
        self._api.create_surrogate(self._settings.task, self._settings.spec())
        if steps := self._settings.description_steps:
            self._api.report_steps(self._settings.task, steps, note="description")

    def _employ_trainer(self) -> Child:
        options = [*self._settings.training_options, "--out", str(self._policy), "--seed", str(self._settings.seed)]
        return self._children.start(
            "trainer",
            "surrogym",
            ["train", *self._common, *options, "--quiet", "--progress-file", str(self._curve)],
        )

    @property
    def _common(self) -> list[str]:
        return [self._settings.task, "--server", self._url, "--wait", str(PATIENCE_SECONDS)]

    def _design(self) -> None:
        with progress("design", quiet=self._quiet) as update:
            self._wait_for_design(update)

    def _wait_for_design(self, update: Callable[[float, str], None], after_round: int = 0) -> SurrogateView:
        """Wait until the design has ended after more rounds than ``after_round``, and return the surrogate."""

        def look(view: SurrogateView) -> None:
            self._children.check()
            update(share_of_design(view), words_of_design(view))

        return wait_for_design(self._api, self._settings.task, PATIENCE_SECONDS, look, after_round=after_round)

    def _train(self, trainer: Child) -> None:
        threading.Thread(target=_warm_up, args=(later_imports(self._settings),), daemon=True).start()
        estimate = ProgressEstimate()
        with progress("train", quiet=self._quiet) as update:
            while trainer.process.poll() is None:
                self._children.check()
                for line in read_curve(self._curve)[-1:]:
                    real = self._api.surrogate(self._settings.task).ledger.total
                    steps, total = line["steps"], line["total_steps"]
                    left = estimate.words_of_time_left(steps, total, line["seconds"])
                    update(estimate.share(steps, total), f"{left}{words_of(line)}, {real} real steps")
                with suppress(subprocess.TimeoutExpired):
                    trainer.process.wait(LOOK_SECONDS)
            trainer.check()
            update(1.0, f"{read_card(self._policy).virtual_steps} virtual steps")

    @property
    def _policy(self) -> Path:
        return self._folder / "policy.zip"

    @property
    def _curve(self) -> Path:
        return self._folder / "training.jsonl"

    @contextmanager
    def _timed(self, phase: str) -> Iterator[None]:
        started = time.monotonic()
        yield
        self._seconds[phase] = time.monotonic() - started


def read_curve(path: Path) -> list[dict[str, Any]]:
    """Return the trainer's progress so far, one dictionary for each complete line of its progress file."""
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    return [json.loads(line) for line in lines if line.endswith("\n")]


def later_imports(settings: DemoSettings) -> tuple[str, ...]:
    """Return the names of the modules that the evaluation and the pictures will need."""
    by_sb3 = settings.search in ALGORITHMS
    pictures = ["surrogym.demo.pictures"] if settings.pictures else []
    return (*(["stable_baselines3"] if by_sb3 else []), *pictures)


def _warm_up(modules: Sequence[str]) -> None:
    """Import modules in advance, while the program waits for the training."""
    with suppress(ImportError):  # if a module is missing, the code that uses it later reports the error
        for module in modules:
            import_module(module)
