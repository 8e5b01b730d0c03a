"""The adaptive design of queries in this process.

It does what the server's designer does, by the same functions on the same arrays, so that the same answers lead to the
same queries. It keeps everything in memory; ``save`` writes it down.

Shapes: n samples, C coordinates, F action entries, T steps of a rollout.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import torch
from numpy.typing import NDArray

from surrogym_client.original.protocol import RealStep
from surrogym_server.convert import default_budget, definition_from_spec
from surrogym_server.engine.design_job import DesignJob, DesignResult, initial_queries, run_design_job
from surrogym_server.environment.actions import model_actions
from surrogym_server.errors import InvalidInput
from surrogym_server.local import LocalSurrogate
from surrogym_server.services.definitions import check_coordinates
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.surrogate_file import RealSamples, SurrogateFile

Floats = NDArray[np.float64]
Phase = Literal["collecting", "sampling", "ready", "over_budget"]


class QueriesOpen(RuntimeError):
    """The next round needs the answers to these queries first. ``ids`` are their numbers."""

    def __init__(self, ids: Sequence[int]) -> None:
        self.ids = tuple(ids)
        super().__init__(f"expected the answers to the queries {list(ids)} first: tell them, or give them up")


@dataclass(frozen=True)
class Query:
    """What the design asks of the real environment: one step from ``coordinates``, or, where no state can be set, the
    ``actions`` one after the other from a reset."""

    id: int
    purpose: Literal["initial", "adaptive"]
    coordinates: tuple[float, ...]  # (C,); empty for a rollout
    actions: tuple[tuple[float, ...], ...]  # (T, F); T is 1 for a step

    @property
    def action(self) -> tuple[float, ...]:
        """The action of a step, (F,): continuous values, or the number of each discrete action."""
        return self.actions[0]


class Design:
    """Chooses real steps until the model is known well enough, or the budget is spent.

    Args:
        spec: what is known of the real environment.
        budget: real steps, at most; None takes that of the specification.
        target: confidence index to reach for each output; None takes that of the specification.
        threads: of a fit.

    Raises:
        InvalidInput: the budget is below 2, or the specification asks for something that is not installed.

    Example:
        >>> design = Design(spec, budget=20)
        >>> while (query := design.ask()) is not None:
        ...     design.tell(query, machine.step_from(query.coordinates, query.action))
        >>> design.phase, design.steps
        ('ready', 6)
    """

    def __init__(
        self, spec: EnvironmentSpec, *, budget: int | None = None, target: float | None = None, threads: int = 1
    ) -> None:
        self.spec = spec
        self.budget = default_budget(spec) if budget is None else budget
        self.target = spec.design.target if target is None else target
        if self.budget < 2:
            raise InvalidInput(f"budget: expected at least 2 real steps, got {self.budget}")
        self._definition = definition_from_spec(spec)
        self._threads = threads
        self._ids = itertools.count(1)
        self._samples: list[RealStep] = []
        self._open: dict[int, Query] = {}
        self._given_up: list[Query] = []
        self._extra = 0
        self._visited: Floats | None = None
        self._phase: Phase = "collecting"
        self._result: DesignResult | None = None
        self._settled = 0  # samples and queries given up before the last fit
        self._state, q, u, rollouts = initial_queries(self._definition, self.budget)
        self._queue = deque(self._queries("initial", q, u, rollouts))

    @property
    def phase(self) -> Phase:
        """``collecting`` the initial queries, ``sampling`` adaptive ones, ``ready``, or ``over_budget``."""
        return self._phase

    @property
    def steps(self) -> int:
        """Real steps that were told."""
        return len(self._samples)

    @property
    def fidelity(self) -> dict[str, Any]:
        """How well the model is known: ``confidence_index`` and more, of all and of each output; empty before a fit."""
        return {} if self._result is None else self._result.fidelity

    def ask(self) -> Query | None:
        """The next query; None once the design has ended. Fits the model when a round has been answered.

        Raises:
            QueriesOpen: the rest of this round was asked already, and is not answered.
            InvalidInput: nothing can be fitted, since fewer than two samples were told.
            NumericalFailure: a covariance can't be factored.
        """
        if not self._queue and self._open:
            raise QueriesOpen(sorted(self._open))
        if not self._queue and (len(self._samples) + len(self._given_up) > self._settled or self._extra):
            self._fit()
        if not self._queue:
            return None
        query = self._queue.popleft()
        self._open[query.id] = query
        return query

    def tell(self, query: Query | None, steps: RealStep | Sequence[RealStep]) -> None:
        """Answer a query with its real step, or with the steps of its rollout, in order.

        Args:
            query: one that was asked; None for steps of one's own, such as those of a log.
            steps: what happened, with the coordinates and the action that were achieved.

        Raises:
            InvalidInput: the query is not open; or a step has another shape, is not finite, or is out of bounds. Then
                nothing is kept.
        """
        taken = [steps] if isinstance(steps, RealStep) else list(steps)
        if query is not None:
            self._require_open(query)
        if not taken or (query is not None and len(taken) > len(query.actions)):
            most = "any number" if query is None else len(query.actions)
            raise InvalidInput(f"expected 1 to {most} steps, got {len(taken)}")
        self._samples += [self._checked(step) for step in taken]
        if query is not None:
            del self._open[query.id]

    def give_up(self, query: Query) -> None:
        """Leave a query without an answer: it counts against the budget, and others like it are not asked.

        Raises:
            InvalidInput: the query is not open.
        """
        self._require_open(query)
        self._given_up.append(self._open.pop(query.id))

    def improve(self, steps: int, visited: Floats | None = None) -> None:
        """Have the next round choose more real steps within the budget, whatever the verdict.

        Args:
            steps: how many.
            visited: states that a policy visits, (v, C): queries are then chosen for where it goes.

        Raises:
            InvalidInput: the budget has not as many left, or the states have another shape.
        """
        left = self.budget - self._spoken_for()
        if not 1 <= steps <= left:
            raise InvalidInput(f"steps: expected 1 to {left}, which is what the budget has left, got {steps}")
        self._visited = None if visited is None else check_coordinates(self._definition, "visited", np.array(visited))
        self._extra = steps

    def surrogate(self) -> LocalSurrogate:
        """The model of the last fit, to be stepped in this process. Raises ``InvalidInput`` before the first fit."""
        return LocalSurrogate.from_bytes(self.spec, self._last().model)

    def save(self, path: str | Path, name: str = "surrogate") -> None:
        """Write specification, model and samples into one file, which ``surrogym import`` gives to a server.

        Raises:
            InvalidInput: there is no model yet.
            OSError: the file can't be written.
        """
        arrays = self._arrays()
        samples = RealSamples(*arrays, truncated=np.array([step.truncated for step in self._samples], dtype=np.bool_))
        Path(path).write_bytes(SurrogateFile(name, self.spec, self._last().model, samples).to_bytes())

    @classmethod
    def load(cls, path: str | Path, **options: Any) -> Self:
        """A design with the samples that ``save`` or ``surrogym export`` wrote. The next ``ask`` fits them.

        Args:
            path: the file.
            options: those of the class: ``budget``, which counts the samples as well, ``target``, ``threads``.

        Raises:
            OSError, NotASurrogateFile: the file can't be read, or is none.
        """
        file = SurrogateFile.load(path)
        design = cls(file.spec, **options)
        fields = (file.samples.coordinates, file.samples.action, file.samples.next_coordinates, file.samples.reward)
        rows = zip(*fields, file.samples.terminated, file.samples.truncated, strict=True)
        design.tell(None, [RealStep(q, u, n, float(r), bool(e), bool(t)) for q, u, n, r, e, t in rows])
        design._queue.clear()
        return design

    def _fit(self) -> None:
        threads = torch.get_num_threads()
        try:
            result = run_design_job(self._job())
        finally:
            torch.set_num_threads(threads)
        self._state, self._result, self._extra = result.state, result, 0
        self._settled = len(self._samples) + len(self._given_up)
        self._queue.extend(
            self._queries("adaptive", result.query_coordinates, result.query_action, result.query_rollouts)
        )
        self._phase = result.phase

    def _job(self) -> DesignJob:
        q, u, q_next, reward, terminated = self._arrays()
        steps = [query for query in self._given_up if query.coordinates]
        rollouts = [query for query in self._given_up if not query.coordinates]
        return DesignJob(
            definition=self._definition,
            coordinates=q,
            action=u,
            next_coordinates=q_next,
            reward=reward,
            terminated=terminated,
            state=self._state,
            budget=self.budget,
            target=self.target,
            pending_coordinates=np.array([query.coordinates for query in steps]) if steps else None,
            pending_action=np.array([query.action for query in steps]) if steps else None,
            pending_rollouts=tuple(np.array(query.actions) for query in rollouts),
            extra_queries=self._extra,
            occupancy=self._visited,
            threads=self._threads,
        )

    def _arrays(self) -> tuple[Floats, Floats, Floats, Floats, NDArray[np.bool_]]:
        def rows(field: str) -> Floats:
            return np.array([getattr(step, field) for step in self._samples], dtype=np.float64)

        ended = np.array([step.terminated for step in self._samples], dtype=np.bool_)
        return rows("coordinates"), rows("action"), rows("next_coordinates"), rows("reward"), ended

    def _queries(
        self, purpose: Literal["initial", "adaptive"], q: Floats, u: Floats, rollouts: Sequence[Floats]
    ) -> list[Query]:
        asked: list[tuple[tuple[float, ...], tuple[tuple[float, ...], ...]]] = [
            (tuple(row), (tuple(action),)) for row, action in zip(q.tolist(), u.tolist(), strict=True)
        ]
        asked += [((), tuple(map(tuple, actions.tolist()))) for actions in rollouts]
        return [Query(next(self._ids), purpose, coordinates, actions) for coordinates, actions in asked]

    def _checked(self, step: RealStep) -> RealStep:
        q = check_coordinates(self._definition, "coordinates", _row(step.coordinates))
        q_next = check_coordinates(self._definition, "next_coordinates", _row(step.next_coordinates))
        u = model_actions(self._definition.action, _row(step.action))
        for what, values in (("coordinates", q), ("next_coordinates", q_next), ("reward", np.array(step.reward))):
            if not np.isfinite(values).all():
                raise InvalidInput(f"{what}: expected finite numbers, got {values.tolist()}")
        return RealStep(q[0], u[0], q_next[0], float(step.reward), bool(step.terminated), bool(step.truncated))

    def _require_open(self, query: Query) -> None:
        if query.id not in self._open:
            raise InvalidInput(f"expected an open query, one of {sorted(self._open)}, got {query.id}")

    def _spoken_for(self) -> int:
        waiting = [*self._queue, *self._open.values(), *self._given_up]
        return len(self._samples) + sum(len(query.actions) for query in waiting)

    def _last(self) -> DesignResult:
        if self._result is None:
            raise InvalidInput("expected a design with a model: answer its first queries, and ask for the next one")
        return self._result


def _row(values: Any) -> Floats:
    return np.asarray(values, dtype=np.float64).reshape(1, -1)
