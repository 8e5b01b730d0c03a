"""Cells of the study: one task, method and seed each. A finished cell is kept in a file and is not run again."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

from surrogym.demo.settings import fingerprint
from surrogym.demo.tasks import DemoTask, Outcome, Target
from surrogym_client.runtime.versions import commit, machine
from surrogym_lab.peers.points import BUDGET, REACHED, TIME, Point
from surrogym_lab.peers.port import BudgetSpent, Clock, NotApplicable, OutOfTime, Real
from surrogym_lab.peers.registry import METHODS, task_of
from surrogym_lab.reproduce.rows import read_records, write_records
from surrogym_sampler.original import make
from surrogym_sampler.original.episode import Episode
from surrogym_sampler.original.episodes import open_episode
from surrogym_trainer.evaluation.evaluator import Evaluation, EvaluationSettings, evaluate
from surrogym_trainer.policies.predict import Acting

LIMIT_MINUTES = 90.0

Tell = Callable[[Point], None]


@dataclass(frozen=True)
class PeerCell:
    """One run of a peer. ``budget`` and ``episodes`` of None are the method's."""

    task: str
    method: str
    seed: int
    budget: int | None = None
    episodes: int | None = None
    minutes: float = LIMIT_MINUTES

    @property
    def real_steps(self) -> int:
        return self.budget or METHODS[self.method].real_steps(task_of(self.task))

    @property
    def judged(self) -> int:
        """Episodes of an evaluation."""
        return self.episodes or METHODS[self.method].episodes

    @property
    def specification(self) -> str:
        """Hash of the task, the method, its settings and the limits. The seed is not in it."""
        settings = {name: repr(value) for name, value in vars(METHODS[self.method].make()).items()}
        asked = {
            "task": asdict(task_of(self.task)),
            "method": self.method,
            "settings": settings,
            "minutes": self.minutes,
        }
        return fingerprint(asked | {"real_steps": self.real_steps, "episodes": self.judged})

    def file(self, folder: Path) -> Path:
        """The file of its points."""
        return folder / "cells" / f"{self.task.replace(':', '.')}-{self.method}-seed{self.seed}.csv"

    def points(self, folder: Path) -> list[Point]:
        """Its points so far, of a run with the same settings."""
        specification = self.specification
        return [p for p in self._kept(folder) if p.specification == specification]

    def occupied(self, folder: Path) -> bool:
        """Whether its file holds a run with other settings, which this cell would overwrite."""
        specification = self.specification
        return any(p.specification != specification for p in self._kept(folder))

    def done(self, folder: Path) -> bool:
        """Whether it has been run to its end, without an error."""
        points = self.points(folder)
        return bool(points) and points[-1].ended in (REACHED, BUDGET, TIME)

    def _kept(self, folder: Path) -> list[Point]:
        """What its file holds, of whatever settings. An empty file, as a full disk leaves it, is no run."""
        file = self.file(folder)
        return read_records(file, Point) if file.exists() and file.stat().st_size else []


def refusals(cells: Iterable[PeerCell]) -> dict[tuple[str, str], str]:
    """Pairs of task and method that can't be learned, with the reason, as far as it is known without learning.

    Raises:
        UnknownEnvironment: a task's environment can't be made.
    """
    found: dict[tuple[str, str], str] = {}
    for task, method in dict.fromkeys((cell.task, cell.method) for cell in cells):
        if (check := METHODS[method].check) is not None:
            try:
                check(make(task_of(task).environment).spec())
            except NotApplicable as error:
                found[task, method] = str(error)
    return found


def run_cell(cell: PeerCell, folder: Path, tell: Tell | None = None) -> list[Point]:
    """Run one cell, and write its points after each round.

    Returns:
        its points. The last one says why the cell ended. A method that failed or can't learn the task has its error
        there.
    """
    _single_thread()
    points: list[Point] = []
    first = begun(cell)
    try:
        for point in _rounds(cell, first):
            points = [*(p for p in points if p.round != point.round), point]
            write_records(cell.file(folder), Point, points)
            if tell is not None:
                tell(point)
    except (NotApplicable, ArithmeticError, RuntimeError, ValueError) as error:
        points.append(replace(points[-1] if points else first, ended=f"{type(error).__name__}: {error}"[:300]))
        write_records(cell.file(folder), Point, points)
    return points


def begun(cell: PeerCell) -> Point:
    """The point of a cell before its first round, on this machine."""
    return Point(
        *(cell.task, cell.method, cell.seed, 0, 0), commit=commit(), specification=cell.specification, machine=machine()
    )


def _rounds(cell: PeerCell, begun: Point) -> Iterator[Point]:
    """Points after each round, then the end of the cell: the last point again, or, if real steps followed it, one more
    with the same policy."""
    task, method = task_of(cell.task), METHODS[cell.method]
    spec = make(task.environment).spec()
    opener = partial(open_episode, task.environment, spec, partial(make, task.environment, spec=spec))
    clock = Clock(60 * cell.minutes)
    real = Real(spec, opener, cell.seed, cell.real_steps, clock)
    point = begun
    try:
        for policy in method.make().learn(real, cell.seed):
            point = replace(point, round=point.round + 1, real_steps=real.steps, cpu_seconds=clock.seconds)
            with clock.pause():
                point = _judged(point, policy, opener, task, cell.judged)
            yield point
            if point.reached:
                return
        ended = BUDGET
    except (BudgetSpent, OutOfTime) as end:
        ended = BUDGET if isinstance(end, BudgetSpent) else TIME
    finally:
        real.close()
    more = int(real.steps > point.real_steps or point.round == 0)
    yield replace(point, round=point.round + more, real_steps=real.steps, cpu_seconds=clock.seconds, ended=ended)


def _judged(point: Point, policy: Acting, opener: Callable[[], Episode], task: DemoTask, episodes: int) -> Point:
    """The point with what the policy earns, and with the end of its cell if it reaches the target."""
    plain = EvaluationSettings(episodes=episodes)
    real = evaluate(deepcopy(policy), opener, plain)  # a memory of its episodes must not enter the second evaluation
    reached = has_target(task.target) and replace(task.target, also_success=None).reached(_outcome(real))
    if reached and task.also is not None and task.target.also_success is not None:
        other = replace(plain, wide=task.also.wide, start_scale=task.also.scale)
        reached = task.target.reached(_outcome(real), _outcome(evaluate(policy, opener, other)))
    told = real.summary()
    return replace(
        point,
        **{name: told[name] for name in ("mean", "iqm", "min", "episodes")},
        success=real.success_rate,
        reached=reached,
        ended=REACHED if reached else "",
    )


def has_target(target: Target) -> bool:
    """Whether a target asks for anything."""
    return any(value is not None for value in (target.mean, target.lowest, target.success))


def _outcome(result: Evaluation) -> Outcome:
    return Outcome(float(result.returns.mean()), float(result.returns.min()), result.success_rate)


def _single_thread() -> None:
    """Let every library compute in one thread: those loaded here at once, and those loaded later by the environment.

    SciPy has its own BLAS. Its threads wait for each other by spinning, which costs more than it gains.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    import torch
    from threadpoolctl import threadpool_limits

    torch.set_num_threads(1)
    threadpool_limits(1)
