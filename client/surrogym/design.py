"""The adaptive design of queries, run in this process without a server.

It calls the same functions as the server's designer, so the same samples lead to the same queries. It keeps everything
in memory; ``save`` writes it to a file.

Shapes: n samples, C coordinates, F action entries, T steps of a rollout.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Protocol, Self
from uuid import uuid4

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from surrogym import checks
from surrogym.files import existing
from surrogym_server.convert import default_budget, definition_from_spec
from surrogym_server.engine.design_job import DesignJob, DesignResult, judge_stored, run_design_job
from surrogym_server.errors import InvalidInput
from surrogym_server.local import LocalSurrogate
from surrogym_server.sampling.design import initial_queries
from surrogym_shared import nouns
from surrogym_shared.nouns import RealStep
from surrogym_shared.port import horizon_of
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.states import Phase
from surrogym_shared.surrogate_file import RealSamples, SurrogateFile

Floats = NDArray[np.float64]
LEAST_SAMPLES = 2  # fewest samples that a model can be fitted to


class QueriesOpen(RuntimeError):
    """Queries of this round still lack an answer. ``ids`` are the numbers of these queries."""

    def __init__(self, ids: Sequence[int]) -> None:
        self.ids = tuple(ids)
        super().__init__(f"expected the answers to the queries {list(ids)} first: tell() them, or give_up() them")


@dataclass(frozen=True, kw_only=True)
class Query(nouns.Query):
    """Request for real steps: one step from ``coordinates``, or, if the environment can't be set to any state, several
    ``actions`` from a snapshot or a reset. A discrete action is given by its number. If ``replan`` is true, take the
    actions from ``Design.acting``."""

    id: int
    purpose: Literal["initial", "adaptive"]
    # Id of the design that made the query, because designs with equal specifications begin with equal queries.
    design: str = field(default="", repr=False)


class CalibratedPrior(Protocol):
    """Protocol of a simulator whose model is the prior of a design, as ``surrogym.Prior`` implements it."""

    file: SurrogateFile | None  # the simulator's model; None before the first update

    def update(self, real: Sequence[RealStep], /) -> bool:
        """Calibrate the simulator's parameters on all real steps so far, and return whether its model changed."""
        ...


class Design:
    """Choose real steps until the model is ready, or the budget is spent.

    Args:
        spec: the specification of the original environment.
        budget: maximum number of real steps, 2 or more; None takes that of the specification.
        target: confidence index to reach for each output, above 0.5 and below 1; None takes that of the specification.
        threads: number of threads of a fit.
        prior: model of what is known beforehand: a ``Prior``, a simulator that is calibrated before each fit, or the
            file of another surrogate with the same coordinates and actions.

    Raises:
        InvalidInput: ``spec`` is not a specification; or another argument is out of its range; or the specification
            needs a package that is not installed.

    Examples:
        >>> design = Design(spec, budget=20)
        >>> while (query := design.ask()) is not None:
        ...     design.tell(query, machine.step_from(query.coordinates, query.action))
        >>> design.phase, design.steps
        ('ready', 6)
    """

    def __init__(
        self,
        spec: EnvironmentSpec,
        *,
        budget: int | None = None,
        target: float | None = None,
        threads: int = 1,
        prior: CalibratedPrior | SurrogateFile | None = None,
    ) -> None:
        checks.require_specification(spec)
        self.spec = spec
        self.budget = default_budget(spec) if budget is None else checks.whole("budget", budget, 2, checks.MOST_STEPS)
        self.target = spec.design.target if target is None else checks.share("target", target)
        self._threads = checks.whole("threads", threads, 1, checks.MOST_THREADS)
        definition = definition_from_spec(spec)
        # Here no policy tries episodes, so the design leaves no steps to them.
        self._definition = replace(definition, design=replace(definition.design, trials=False))
        self._prior = prior
        self._name = uuid4().hex
        self._ids = itertools.count(1)
        self._samples: list[RealStep] = []
        self._open: dict[int, Query] = {}
        self._answered: list[Query] = []
        self._given_up: list[Query] = []
        self._extra = 0
        self._visited: Floats | None = None
        self._phase: Phase = "collecting"
        self._result: DesignResult | None = None
        self._settled = 0  # sum of the samples and of the queries that were given up, at the last fit
        self._state: dict[str, Any] = {}
        self._snapshots: dict[str, nouns.Vector] = {}  # for each snapshot, by its name, the state (C,) that it restores
        self._queue = deque(self._numbered("initial", initial_queries(self._definition, self.budget)))

    def __repr__(self) -> str:
        name = self.spec.environment or "own environment"
        steps = f"{self.steps} of {self.budget} real steps"
        return f"<Design of {name}: {self.phase}, {steps}, {len(self._open)} open queries>"

    @property
    def phase(self) -> Phase:
        """Phase of the design: ``collecting`` the initial queries, ``sampling`` adaptive ones, ``ready``,
        ``over_budget`` if the budget was spent before, or ``unsure`` if no useful query is left although the
        budget is not spent."""
        return self._phase

    @property
    def steps(self) -> int:
        """Number of real steps that ``tell`` has received."""
        return len(self._samples)

    @property
    def fidelity(self) -> dict[str, Any]:
        """Measures of how well the model predicts, such as ``confidence_index``, overall and for each output. Empty
        before the first fit."""
        return {} if self._result is None else self._result.fidelity

    def ask(self) -> Query | None:
        """Return the next query, or None once the design has ended. Fits the model when all queries of a round are
        answered.

        Raises:
            QueriesOpen: all queries of this round were handed out, and some lack an answer.
            InvalidInput: the model can't be fitted, because ``tell`` has received fewer than two real steps, and no
                query is left.
            NumericalFailure, PluginFailed: the fit fails.
        """
        if not self._queue and self._open:
            raise QueriesOpen(sorted(self._open))
        if not self._queue and len(self._samples) < LEAST_SAMPLES:
            raise InvalidInput(
                f"a model needs at least {LEAST_SAMPLES} samples, got {len(self._samples)}, and no query is left: "
                "tell(None, steps) adds steps of your own"
            )
        if not self._queue and (len(self._samples) + len(self._given_up) > self._settled or self._extra):
            self._fit()
        if not self._queue:
            return None
        query = self._queue.popleft()
        self._open[query.id] = query
        return query

    def acting(self, query: Query) -> Callable[[int, ArrayLike], nouns.Vector]:
        """Return a function that gives the action (F,) of each step of a query. Its arguments are the number of the
        step, from 0, and the state (C,) that was measured before it.

        It gives ``query.actions`` in order. If ``query.replan`` is true, it plans each action anew on the latest model,
        so that the steps lead to their aim although the model is not exact. This makes a planner first, in some
        seconds.

        Raises:
            InvalidInput: the query is not open.
        """
        self._require_open(query)
        if not query.replan:
            return lambda number, _: query.actions[number]
        noise = {output["name"]: output["sensor_noise"] for output in self.fidelity["outputs"]}
        planner = self.surrogate().planner(horizon_of(self.spec), query.id, sensor_noise=noise)
        return lambda _, state: tuple(planner.from_states(np.array([state], dtype=np.float64))[0].tolist())

    def tell(
        self, query: Query | None, steps: RealStep | Sequence[RealStep], snapshots: Sequence[str | None] = ()
    ) -> None:
        """Answer a query with its real step, or with the steps of its rollout in order.

        Args:
            query: a query from ``ask``; None for steps of your own, such as those of a log.
            steps: the real steps, with the coordinates and the actions that were actually achieved.
            snapshots: for each step, the name under which you saved the state after it, or None. Later queries may
                begin there.

        Raises:
            InvalidInput: the query is not open; or a step has the wrong shape, is not finite, is absurdly far from the
                sampling range, or has an action out of bounds. The design then keeps none of the steps.
        """
        taken = checks.steps_of(steps)
        if query is not None:
            self._require_open(query)
        if not taken or (query is not None and len(taken) > query.steps):
            raise InvalidInput(f"steps: expected {_count_of(query)}, got {len(taken)}")
        if snapshots and len(snapshots) != len(taken):
            raise InvalidInput(f"snapshots: expected one entry for each of {len(taken)} steps, got {len(snapshots)}")
        told = [checks.real_step(self._definition, step) for step in taken]
        self._samples += told
        for name, step in zip(snapshots, told, strict=False):
            if name is not None:
                self._snapshots[name] = tuple(np.asarray(step.next_coordinates, dtype=np.float64).tolist())
        if query is not None:
            self._answered.append(self._open.pop(query.id))

    def give_up(self, query: Query) -> None:
        """Leave a query unanswered. The query still counts towards the budget, and similar queries are avoided. If it
        begins at a snapshot, no later query begins at this snapshot.

        Raises:
            InvalidInput: the query is not open.
        """
        self._require_open(query)
        self._given_up.append(self._open.pop(query.id))
        self._snapshots.pop(query.snapshot or "", None)

    def improve(self, steps: int, visited: Floats | None = None) -> None:
        """Add real steps to the next round within the budget, even if the design is ready.

        Args:
            steps: number of real steps.
            visited: states (v, C), at least one, that a policy visits. The queries then improve the model there.

        Raises:
            InvalidInput: the budget has fewer steps left, or the states have the wrong shape or are not finite.
        """
        left = self.budget - self._spoken_for()
        wanted = checks.whole("steps", steps, 1, left, why=", the rest of the budget")
        self._visited = None if visited is None else checks.states(self._definition, "visited", visited)
        self._extra = wanted

    def surrogate(self) -> LocalSurrogate:
        """Return the model of the last fit, to be stepped in this process.

        Raises:
            InvalidInput: there was no fit yet.
        """
        return LocalSurrogate.from_bytes(self.spec, self._last().model)

    def save(self, path: str | Path, name: str = "surrogate") -> None:
        """Write specification, model and samples to one file.

        ``surrogym import`` sends the file to a server, and ``load`` continues the design from it. The file's
        specification contains the target, and the budget less the steps of queries that were given up.

        Raises:
            InvalidInput: there is no model yet.
            OSError: the file can't be written.
        """
        Path(path).write_bytes(self.to_file(name).to_bytes())

    def to_file(self, name: str = "surrogate") -> SurrogateFile:
        """Return the content of the file that ``save`` writes. Raises ``InvalidInput`` if there is no model yet."""
        result, steps = self._last(), self._steps()
        truncated = np.array([step.truncated for step in self._samples], dtype=np.bool_)
        columns = (steps.coordinates, steps.action, steps.next_coordinates, steps.reward, steps.terminated)
        samples = RealSamples(*columns, truncated)
        tolerances = {output["name"]: output["tolerance"] for output in result.fidelity["outputs"]}
        return SurrogateFile(name, self._spec_to_save(), result.model, samples, tolerances)

    @classmethod
    def load(cls, path: str | Path, **options: Any) -> Self:
        """Restore a design from a file that ``save`` or ``surrogym export`` wrote.

        The design has the file's model and samples, and the phase that follows from them. It returns the queries that
        the saved design would have returned.

        Args:
            path: the file.
            options: arguments of the class: ``budget``, which includes the file's samples, ``target``, ``threads``.

        Raises:
            OSError: the file can't be read.
            NotASurrogateFile: the file is not an exported surrogate.
            InvalidInput: the file's model does not fit its specification, or an option is out of its range.
        """
        file = SurrogateFile.load(existing(path))
        design = cls(file.spec, **options)
        fields = (file.samples.coordinates, file.samples.action, file.samples.next_coordinates, file.samples.reward)
        rows = zip(*fields, file.samples.terminated, file.samples.truncated, strict=True)
        if len(file.samples):
            design.tell(None, [RealStep(q, u, n, float(r), bool(e), bool(t)) for q, u, n, r, e, t in rows])
        design._queue.clear()
        design._take_up(file)
        return design

    def _take_up(self, file: SurrogateFile) -> None:
        """Restore result and phase from the model of a loaded file, to continue after the round that fitted it.

        The next ``ask`` fits again if the file has later samples, or if the budget or the target requires more.
        """
        known = [file.tolerances.get(output) for output in self._definition.outputs]
        usual = [tolerance for tolerance in known if tolerance is not None]
        if len(usual) == len(known):
            self._state = self._state | {"usual": usual}
        self._result = judge_stored(self._job(), file.model)
        if self._result.verdict == "continue":
            self._phase = "sampling"
        else:
            self._phase, self._settled = self._result.phase, len(self._samples)

    def _spec_to_save(self) -> EnvironmentSpec:
        budget = max(2, self.budget - sum(query.steps for query in self._given_up))
        initial = self.spec.design.initial
        changed = {
            "budget": budget,
            "target": self.target,
            "initial": None if initial is None else min(initial, budget),
        }
        if self.budget == default_budget(self.spec) and not self._given_up:
            changed = {"target": self.target}
        return self.spec.model_copy(update={"design": self.spec.design.model_copy(update=changed)})

    def _fit(self) -> None:
        if self._prior is not None and not isinstance(self._prior, SurrogateFile):
            self._prior.update(self._samples)
        threads = torch.get_num_threads()
        try:
            result = run_design_job(self._job())
        finally:
            torch.set_num_threads(threads)
        self._state, self._result, self._extra = result.state, result, 0
        self._settled = len(self._samples) + len(self._given_up)
        self._queue.extend(self._numbered("adaptive", result.queries))
        self._phase = result.phase

    def _job(self) -> DesignJob:
        return DesignJob(
            definition=self._definition,
            samples=self._steps(),
            state=self._state,
            budget=self.budget,
            target=self.target,
            pending=tuple(self._given_up),
            snapshots=dict(self._snapshots),
            extra_queries=self._extra,
            occupancy=self._visited,
            threads=self._threads,
            previous=None if self._result is None else self._result.model,
            prior=self._prior_model(),
        )

    def _prior_model(self) -> bytes | None:
        file = self._prior if self._prior is None or isinstance(self._prior, SurrogateFile) else self._prior.file
        return None if file is None else file.model

    def _steps(self) -> nouns.RealSteps:
        return nouns.RealSteps.of(self._samples, "manual")

    def _numbered(self, purpose: Literal["initial", "adaptive"], queries: Sequence[nouns.Query]) -> list[Query]:
        return [
            Query(
                q.coordinates, q.actions, q.snapshot, q.replan, id=next(self._ids), purpose=purpose, design=self._name
            )
            for q in queries
        ]

    def _require_open(self, query: Query) -> None:
        if not isinstance(query, Query):
            raise InvalidInput(f"expected a Query that ask() returned, got {type(query).__name__}")
        if self._open.get(query.id) == query:
            return
        why = "was answered already" if query in self._answered else "belongs to another design"
        why = "was given up" if query in self._given_up else why
        raise InvalidInput(f"expected an open query, got query {query.id}, which {why}: call ask() for the next query")

    def _spoken_for(self) -> int:
        waiting = [*self._queue, *self._open.values(), *self._given_up]
        return len(self._samples) + sum(query.steps for query in waiting)

    def _last(self) -> DesignResult:
        if self._result is None:
            raise InvalidInput("expected a design with a model: answer its first queries, then call ask() again")
        return self._result


def _count_of(query: Query | None) -> str:
    if query is None:
        return "at least 1 step"
    return "1 step" if query.steps == 1 else f"1 to {query.steps} steps"
