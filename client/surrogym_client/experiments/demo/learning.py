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

from surrogym_client.evaluation.reporting import as_reported, paired_start
from surrogym_client.experiments.demo.judging import Judgement
from surrogym_client.experiments.processes import Child, Children, await_file
from surrogym_client.experiments.settings import DemoSettings
from surrogym_client.experiments.tasks import ROUNDS, queries_a_round
from surrogym_client.policies import pushing
from surrogym_client.policies.card import read_card
from surrogym_client.surrogates.waiting import share_of_design, wait_for_design, words_of_design
from surrogym_client.training.search import ALGORITHMS
from surrogym_client.training.words import words_of
from surrogym_client.transport.api import Api
from surrogym_client.transport.connection import Retries
from surrogym_shared.terminal import progress, say
from surrogym_shared.wire import SurrogateView

LEDGER = ("initial", "adaptive", "total", "unresolved", "audit")
PATIENCE_SECONDS = 3_600.0
REPORT = "report.html"  # in the run folder
LOOK_SECONDS = 1.0  # each poll costs the server a little of the trainer's time


@dataclass(frozen=True)
class Learned:
    """A trained policy and what it cost.

    Attributes:
        policy: its file.
        real_queries: numbers of real steps: initial, adaptive, their total, unresolved, and those of audits.
        seconds: duration of each phase, by its name.
        confidence_index, fidelity, phase: state of the surrogate; None for a policy trained without a surrogate.
    """

    policy: Path
    real_queries: dict[str, int]  # initial, adaptive, total of these, unresolved, and of audits
    seconds: dict[str, float]
    confidence_index: float | None = None
    fidelity: dict[str, Any] | None = None
    phase: str | None = None


class SurrogateRun:
    """One run: a server, a sampler and a trainer, phase by phase."""

    def __init__(self, settings: DemoSettings, folder: Path, children: Children, *, quiet: bool) -> None:
        self._settings = settings
        self._folder = folder
        self._children = children
        self._quiet = quiet
        self._seconds: dict[str, float] = {}
        with self._timed("start"):
            self._api = Api(self._serve(), token="", retries=Retries(seconds=10.0))

    def learn(self) -> Learned:
        """Run the design and the training. In the closed loop the trainer starts early, so that it imports during the
        design."""
        self._employ_sampler()
        early = self._employ_trainer() if self._settings.way.closed_loop else None
        with self._timed("design"):
            self._design()
        with self._timed("train"):
            self._train(early or self._employ_trainer())
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
        """Enter the evaluation into the ledger, store its episodes with the policy, and write specification, samples
        and, unless unwanted, pictures."""
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
            from surrogym_client.experiments.demo.pictures import draw_all

            self._write_report(name)
            draw_all(self._folder, view, list(self._api.samples(name)), read_curve(self._curve), judgement.real.result)

    def _write_report(self, name: str) -> None:
        from surrogym_client.report.files import write
        from surrogym_client.report.known import collect, cuts_of
        from surrogym_client.report.page import page

        known = collect(self._api, name)
        write(self._folder / REPORT, page(known, cuts_of(self._api, known)[0]))

    def linger(self) -> None:
        """Leave the server running until Ctrl-C."""
        say(f"the server stays at {self._api.url} until Ctrl-C")
        with suppress(KeyboardInterrupt):
            while True:
                time.sleep(3_600)

    def _serve(self) -> str:
        say("starting server, sampler and trainer", quiet=self._quiet)
        ready, database = self._folder / "server.url", self._folder / "surrogym.db"
        options = ["--port", "0", "--database", str(database), "--ready-file", str(ready), "--log-level", "warning"]
        return await_file(self._children.start("server", "surrogym_server", ["serve", *options]), ready)

    def _employ_sampler(self) -> None:
        say(f"live server, with a page to look at: {self._api.url}  (run folder: {self._folder})", quiet=self._quiet)
        self._api.create_surrogate(self._settings.task, self._settings.spec())
        if steps := self._settings.description_steps:
            self._api.report_steps(self._settings.task, steps, note="description")
        named = self._settings.demo_task.environment
        own = ["--env", named] if ":" in named else []  # the sampler does not import a module that only a server names
        self._children.start("sampler", "surrogym_client", ["sample", *self._common, *own])

    def _employ_trainer(self) -> Child:
        steps, queries = self._settings.virtual_steps, queries_a_round(self._settings.real_steps)
        options = [] if steps is None else ["--steps", str(steps)]
        if self._settings.algorithm is not None:
            options += ["--algorithm", self._settings.algorithm]
        if self._settings.way.start_box is not None:
            options += ["--start-box", str(self._settings.way.start_box)]
        options.append("--prolong" if self._settings.prolong else "--no-prolong")
        if self._settings.way.closed_loop and queries:
            options += ["--improve", str(queries), "--rounds", str(ROUNDS)]
        options += ["--out", str(self._policy), "--seed", str(self._settings.seed), "--quiet"]
        return self._children.start(
            "trainer", "surrogym_client", ["train", *self._common, *options, "--progress-file", str(self._curve)]
        )

    @property
    def _common(self) -> list[str]:
        return [self._settings.task, "--server", self._api.url, "--wait", str(PATIENCE_SECONDS)]

    def _design(self) -> None:
        with progress("design", quiet=self._quiet) as update:

            def look(view: SurrogateView) -> None:
                self._children.check()
                update(share_of_design(view), words_of_design(view))

            view = wait_for_design(self._api, self._settings.task, PATIENCE_SECONDS, look)
            if not self._settings.way.closed_loop:
                self._spend_the_rest(view, look)

    def _spend_the_rest(self, view: SurrogateView, look: Callable[[SurrogateView], None]) -> None:
        """Add queries one by one if the design was ready before its budget was spent."""
        name, budget, before = self._settings.task, self._settings.real_steps, -1
        while before < view.ledger.total < budget:
            before = view.ledger.total
            self._api.improve(name, 1)
            view = wait_for_design(self._api, name, PATIENCE_SECONDS, look, after_round=view.round)

    def _train(self, trainer: Child) -> None:
        threading.Thread(target=_warm_up, args=(later_imports(self._settings),), daemon=True).start()
        with progress("train", quiet=self._quiet) as update:
            while trainer.process.poll() is None:
                self._children.check()
                for line in read_curve(self._curve)[-1:]:
                    real = self._api.surrogate(self._settings.task).ledger.total
                    update(line["steps"] / line["total_steps"], f"{words_of(line)}, {real} real steps")
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
    """The trainer's progress so far. An unfinished line is left for the next call."""
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    return [json.loads(line) for line in lines if line.endswith("\n")]


def later_imports(settings: DemoSettings) -> tuple[str, ...]:
    """Modules that evaluation and pictures will need."""
    by_sb3 = settings.search in ALGORITHMS
    pictures = ["surrogym_client.experiments.demo.pictures"] if settings.pictures else []
    return (*(["stable_baselines3"] if by_sb3 else []), *pictures)


def _warm_up(modules: Sequence[str]) -> None:
    """Import modules while the program waits."""
    with suppress(ImportError):  # the code that needs it reports the error
        for module in modules:
            import_module(module)
