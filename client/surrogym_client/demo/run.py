"""The demo from its first process to its run folder."""

from __future__ import annotations

import json
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Any, Literal

from surrogym_client.api import Api
from surrogym_client.cli.errors import CommandError
from surrogym_client.cli.output import progress, say
from surrogym_client.cli.train import words_of
from surrogym_client.connection import Retries
from surrogym_client.demo.processes import Child, Children, await_file
from surrogym_client.demo.report import metrics_of
from surrogym_client.evaluate import Evaluation, EvaluationSettings, evaluate
from surrogym_client.original import make
from surrogym_client.original.episodes import open_episode
from surrogym_client.policy_file import load_policy, read_card
from surrogym_client.waiting import wait_for_design
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import SurrogateView

PATIENCE_SECONDS = 3_600.0
LOOK_SECONDS = 0.2
MIN_DESIGN = 20
ROUNDS = 3  # of the closed loop, while the design is not ready


@dataclass(frozen=True)
class DemoTask:
    """What a demo solves, and the real steps it may spend. Training derives everything else from the spec."""

    environment: str
    budget: int

    @property
    def design_budget(self) -> int:
        """What the design may spend before the first policy: two fifths, and not too few to begin with."""
        return min(self.budget, max(MIN_DESIGN, 2 * self.budget // 5))

    @property
    def queries_a_round(self) -> int:
        """What each round of the closed loop may spend."""
        return max(1, (self.budget - self.design_budget) // ROUNDS)


TASKS = {
    "pendulum": DemoTask("Pendulum-v1", budget=30),
    "cartpole": DemoTask("CartPole-v1", budget=30),
    "mountaincar": DemoTask("MountainCarContinuous-v0", budget=40),
    "acrobot": DemoTask("Acrobot-v1", budget=100),
    "invertedpendulum": DemoTask("InvertedPendulum-v5", budget=20),
    "reacher": DemoTask("Reacher-v5", budget=100),
}


@dataclass(frozen=True)
class DemoSettings:
    task: str = "pendulum"
    seed: int = 0
    budget: int | None = None
    preset: Literal["default", "paper"] | None = None
    steps: int | None = None
    episodes: int = 100
    keep: bool = False

    def spec(self) -> EnvironmentSpec:
        """The task's specification with these choices. Under ``paper`` the preset's own budget counts."""
        task = TASKS[self.task]
        budget = self.budget or (None if self.preset == "paper" else task.design_budget)
        return make(task.environment, preset=self.preset, budget=budget, seed=self.seed).spec()


def run_demo(
    settings: DemoSettings,
    out: Path | None = None,
    tell: Callable[[dict[str, Any], Path], None] | None = None,
    *,
    quiet: bool = False,
) -> None:
    """Run the whole loop, then ``tell`` the metrics, which also lie in the run folder, and where that is.

    Raises:
        CommandError: the folder is not empty, or a process ended badly; says which, its last words and its log.
        SurrogymClientError: the server refused, or the design failed.
    """
    folder = _empty_folder(out or _new_folder(settings))
    with _terminations_as_interrupts(), _told_what_stays(folder), Children(folder) as children:
        run = DemoRun(settings, folder, children, quiet=quiet)
        metrics = run.whole()
        if tell is not None:
            tell(metrics, folder)
        if settings.keep:
            say(f"the server stays at {run.api.url} until Ctrl-C")
            _sleep_for_ever()


class DemoRun:
    """One run: a server, a sampler and a trainer, phase by phase."""

    def __init__(self, settings: DemoSettings, folder: Path, children: Children, *, quiet: bool) -> None:
        self._settings = settings
        self._folder = folder
        self._children = children
        self._quiet = quiet
        self._started = time.monotonic()
        self._spec = settings.spec()
        self._seconds: dict[str, float] = {}
        self.api = Api(self._serve(), token="", retries=Retries(seconds=10.0))

    def whole(self) -> dict[str, Any]:
        """Design, train, evaluate, report."""
        trainer = self._employ()
        with self._timed("design"):
            self._design()
        with self._timed("train"):
            self._train(trainer)
        with self._timed("evaluate"):
            result = self._evaluate()
        return self._report(result)

    def _serve(self) -> str:
        say("starting server, sampler and trainer", quiet=self._quiet)
        ready, database = self._folder / "server.url", self._folder / "surrogym.db"
        options = ["--port", "0", "--database", str(database), "--ready-file", str(ready), "--log-level", "warning"]
        return await_file(self._children.start("server", "surrogym_server", ["serve", *options]), ready)

    def _employ(self) -> Child:
        """Sampler and trainer. The trainer imports what it needs while the design goes on."""
        name, url, wait = self._settings.task, self.api.url, str(PATIENCE_SECONDS)
        say(f"live server: {url}  (run folder: {self._folder})", quiet=self._quiet)
        self.api.create_surrogate(name, self._spec)
        common = [name, "--server", url, "--wait", wait]
        self._children.start("sampler", "surrogym_client", ["sample", *common])
        steps = [] if self._settings.steps is None else ["--steps", str(self._settings.steps)]
        improve = [] if self._settings.budget or self._settings.preset == "paper" else self._rounds
        options = [*improve, "--out", str(self.policy), "--seed", str(self._settings.seed), *steps, "--quiet"]
        return self._children.start(
            "trainer", "surrogym_client", ["train", *common, *options, "--progress-file", str(self._curve)]
        )

    @property
    def _rounds(self) -> list[str]:
        return ["--improve", str(TASKS[self._settings.task].queries_a_round), "--rounds", str(ROUNDS)]

    def _design(self) -> None:
        with progress("design", quiet=self._quiet) as update:

            def look(view: SurrogateView) -> None:
                self._children.check()
                share = 1.0 if view.phase in ("ready", "over_budget") else view.samples / view.budget
                update(min(1.0, share), _design_words(view))

            wait_for_design(self.api, self._settings.task, PATIENCE_SECONDS, look)

    def _train(self, trainer: Child) -> None:
        threading.Thread(target=_warm_up, daemon=True).start()
        with progress("train", quiet=self._quiet) as update:
            while trainer.process.poll() is None:
                self._children.check()
                for line in read_curve(self._curve)[-1:]:
                    real = self.api.surrogate(self._settings.task).ledger.total
                    update(line["steps"] / line["total_steps"], f"{words_of(line)}, {real} real steps")
                time.sleep(LOOK_SECONDS)
            trainer.check()
            update(1.0, f"{read_card(self.policy).virtual_steps} virtual steps")

    def _evaluate(self) -> Evaluation:
        episodes = EvaluationSettings(episodes=self._settings.episodes)
        with progress("evaluate", quiet=self._quiet) as update:
            update(0.0, "loading the policy")
            predict = load_policy(self.policy, read_card(self.policy).algorithm)
            name, spec = self._spec.environment, self._spec
            opener = partial(open_episode, name, spec, partial(make, name, spec=spec))
            n = episodes.episodes

            def look(share: float, ended: int) -> None:
                update(share, f"{n} real episodes, {ended} terminated")

            result = evaluate(predict, opener, episodes, look)
        self.api.report_steps(self._settings.task, result.steps, episodes=episodes.episodes, note="demo")
        return result

    def _report(self, result: Evaluation) -> dict[str, Any]:
        from surrogym_client.demo.pictures import draw_all

        name = self._settings.task
        view, samples = self.api.surrogate(name), list(self.api.samples(name))
        for file_format in ("csv", "npz"):
            content = self.api.export_samples(name, file_format)
            (self._folder / f"samples.{file_format}").write_bytes(content)
        (self._folder / "spec.json").write_text(view.spec.model_dump_json(indent=2) + "\n", encoding="utf-8")
        draw_all(self._folder, view, samples, read_curve(self._curve), result)
        seconds = {**self._seconds, "total": time.monotonic() - self._started}
        metrics = metrics_of(name, self._settings.seed, view, read_card(self.policy), result, seconds)
        metrics["demo"] = asdict(self._settings)
        (self._folder / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
        return metrics

    @property
    def policy(self) -> Path:
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
    """The trainer's progress so far; a line that is being written is left for the next look."""
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    return [json.loads(line) for line in lines if line.endswith("\n")]


def _warm_up() -> None:
    """Import what evaluation and pictures need while there is nothing to do but wait."""
    with suppress(ImportError):  # told by whoever needs it
        for module in ("stable_baselines3", "surrogym_client.demo.pictures"):
            import_module(module)


def _design_words(view: SurrogateView) -> str:
    ledger = view.ledger
    fidelity = "" if view.fidelity is None else f", confidence index {view.fidelity.confidence_index:.4f}"
    return f"{ledger.total} of {view.budget} real steps ({ledger.adaptive} adaptive){fidelity}"


def _new_folder(settings: DemoSettings) -> Path:
    return Path("runs") / f"{settings.task}-seed{settings.seed}-{time.strftime('%Y%m%d-%H%M%S')}"


def _empty_folder(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.iterdir()):
        raise CommandError(f"expected an empty run folder, got {folder}, where there is something already")
    return folder.resolve()


@contextmanager
def _terminations_as_interrupts() -> Iterator[None]:
    """A polite kill is taken like Ctrl-C, so that the children are ended on the way out."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        del number, frame
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _told_what_stays(folder: Path) -> Iterator[None]:
    """Say after an interruption what there is to go on with."""
    try:
        yield
    except KeyboardInterrupt:
        database, policy = folder / "surrogym.db", folder / "policy.zip"
        kept = [f"the real samples (surrogym serve --database {database})"] if database.exists() else []
        kept += [f"the policy so far ({policy})"] if policy.exists() else []
        say(f"interrupted; all processes have ended; kept in {folder}: {' and '.join(kept) or 'logs alone'}")
        raise


def _sleep_for_ever() -> None:
    try:
        while True:
            time.sleep(3_600)
    except KeyboardInterrupt:
        return
