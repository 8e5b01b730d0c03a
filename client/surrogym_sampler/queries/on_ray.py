"""Samplers as actors of a Ray cluster. Ray starts an actor again if its process or machine dies."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from typing import Any, get_args
from uuid import uuid4

from surrogym_client.errors import SurrogymClientError
from surrogym_client.transport.api import Api
from surrogym_sampler.original.errors import OriginalError
from surrogym_sampler.original.loading import for_queries
from surrogym_sampler.queries.settings import Outcome, SamplerPlan, SamplerReport
from surrogym_sampler.queries.words import Line, line_of
from surrogym_sampler.queries.worker import Sampler
from surrogym_shared.wire import Query

IDLE_SECONDS = 5.0  # longest wait of a claim for queries; a sampler can stop only between claims
LOOK_SECONDS = 1.0  # seconds between two checks of whether samplers have ended, and of what they report
STOP_SECONDS = 15.0  # seconds in which stopped samplers have to end, in addition to the seconds that one step may take
NO_MODULE = "No module named "
WITHOUT_CODE = (
    "; install it on each machine of the cluster, or bring it by --runtime-env FILE, a YAML file with working_dir: ."
)
OF_STEPS = ("steps", "fallback_steps")  # fields of a report that count steps; those that count queries are outcomes


@dataclass(frozen=True)
class Look:
    """The state of a running sampler.

    Attributes:
        start: an id that differs after each start of the process.
        host: name of the machine.
        process: id of the process.
        report: counts since the start.
        lines: lines of output since the last look.
    """

    start: str
    host: str
    process: int
    report: SamplerReport
    lines: tuple[Line, ...] = ()


@dataclass(frozen=True)
class Ended:
    """The last state of a sampler that has ended; ``error`` is None unless an error ended it."""

    look: Look
    error: str | None = None


class SamplerActor:
    """One sampler in a process of the cluster. ``look`` and ``stop`` may be called while ``run`` runs."""

    def __init__(self, plan: SamplerPlan) -> None:
        self._plan = plan
        self._start = uuid4().hex
        self._lines: list[Line] = []
        self._sampler: Sampler | None = None
        self._stopped = False

    def run(self) -> Ended:
        """Answer queries until the plan's settings end the sampler, or ``stop`` is called."""
        plan = self._plan
        if (here := version("surrogym")) != plan.version:
            wrong = (
                f"expected surrogym {plan.version} on every machine of the cluster, got {here} on {platform.node()}: "
                "install the same version there"
            )
            return Ended(self.look(), wrong)
        try:
            with (
                Api(plan.url, plan.token) as api,
                closing(for_queries(plan.environment, plan.step_limit, plan.spec, plan.fallback)) as environment,
            ):
                self._sampler = Sampler(api, plan.surrogate, environment, plan.settings, self._note)
                if self._stopped:
                    self._sampler.stop()
                self._sampler.run()
        except (SurrogymClientError, OriginalError) as error:
            return Ended(self.look(), f"{error}{WITHOUT_CODE if NO_MODULE in str(error) else ''}")
        return Ended(self.look())

    def look(self) -> Look:
        report = SamplerReport() if self._sampler is None else self._sampler.summary()
        lines, self._lines = self._lines, []
        return Look(self._start, platform.node(), os.getpid(), report, tuple(lines))

    def stop(self) -> None:
        """Let ``run`` end after the running step, or after a claim that waits for queries."""
        self._stopped = True
        if self._sampler is not None:
            self._sampler.stop()

    def _note(self, query: Query, outcome: Outcome, error: str) -> None:
        self._lines.append(Line(line_of(query, outcome, error), bool(error)))


@dataclass
class _Member:
    """One sampler of the cluster, with what this process knows about it."""

    name: str
    actor: Any
    run: Any  # Ray's reference to the result of the sampler's run
    asked: Any  # Ray's reference to the requested result of ``look``, which has not arrived yet
    # the last known report of each process that ran this sampler, by its start id
    reports: dict[str, SamplerReport] = field(default_factory=dict)


@dataclass(frozen=True)
class News:
    """The new output lines of all samplers since the last call of ``look``, and whether all samplers have ended."""

    lines: tuple[Line, ...]
    over: bool  # whether all samplers have ended


class RaySamplers:
    """Samplers in the Ray cluster to which this process is connected. They end when this process ends, for whatever
    reason.

    Args:
        plan: what each sampler needs to work. The number of the sampler is added to ``settings.name``.
        count: number of samplers.
        resources: what each sampler takes of the cluster, by Ray's names: ``CPU``, ``GPU``, ``memory`` or a custom
            name.

    Raises:
        ValueError: Ray refuses the resources.
    """

    def __init__(self, plan: SamplerPlan, count: int, resources: Mapping[str, float]) -> None:
        import ray

        self._ray: Any = ray
        self._step_limit = plan.step_limit
        self.errors: list[str] = []
        self._needs = {"CPU": 1.0, **resources}
        self.takes = amounts(self._needs)
        options = {**_options(resources), "max_restarts": -1, "max_concurrency": 4}
        made: Any = ray.remote(SamplerActor).options(**options)
        self._members: list[_Member] = []
        for number in range(count):
            name = f"{plan.settings.name}-{number}"[-128:]
            settings = replace(plan.settings, name=name, wait_seconds=IDLE_SECONDS)
            actor: Any = made.remote(replace(plan, settings=settings))
            self._members.append(
                _Member(name, actor, actor.run.options(max_task_retries=-1).remote(), actor.look.remote())
            )
        self._running = list(self._members)

    @property
    def running(self) -> int:
        """Number of samplers that have not ended, including those that wait for free resources."""
        return len(self._running)

    @property
    def waiting(self) -> int:
        """Number of samplers that have not begun yet."""
        return sum(not member.reports for member in self._running)

    def lacking(self) -> dict[str, float]:
        """Return the free amount of each resource of which the cluster has too little for one sampler."""
        free: dict[str, float] = self._ray.available_resources()
        return {name: free.get(name, 0.0) for name, amount in self._needs.items() if free.get(name, 0.0) < amount}

    @property
    def restarts(self) -> int:
        """Number of times that a sampler was started again."""
        return sum(max(0, len(member.reports) - 1) for member in self._members)

    def look(self, seconds: float = LOOK_SECONDS) -> News:
        """Wait up to ``seconds`` for a sampler to end, and return what is new."""
        lines: list[Line] = []
        ended, _ = self._ray.wait([member.run for member in self._running], timeout=seconds, fetch_local=False)
        for member in self._running:
            done, _ = self._ray.wait([member.asked], timeout=0)
            if done:
                lines += self._heard(member)
        for member in [member for member in self._running if member.run in ended]:
            lines += self._ended(member)
        return News(tuple(lines), not self._running)

    def stop(self) -> None:
        """Let each sampler finish its running step and return its other queries; kill those that take too long."""
        for member in self._running:
            member.actor.stop.remote()
        deadline = time.monotonic() + self._step_limit + STOP_SECONDS
        try:
            while any(member.reports for member in self._running) and time.monotonic() < deadline:
                self.look()
        finally:
            self.end()

    def end(self) -> None:
        """Kill all samplers at once."""
        for member in self._members:
            self._ray.kill(member.actor, no_restart=True)
        self._running = []

    def report(self) -> SamplerReport:
        """Return the sum of all samplers' reports. The last second of a process that died may be missing."""
        all_reports = [report for member in self._members for report in member.reports.values()]
        phases = [report.phase for report in all_reports if report.phase is not None]
        counted = (*get_args(Outcome), *OF_STEPS)
        counts = {name: sum(getattr(report, name) for report in all_reports) for name in counted}
        seconds = max((report.seconds for report in all_reports), default=0.0)
        return SamplerReport(**counts, seconds=seconds, phase=phases[-1] if phases else None)

    def _heard(self, member: _Member) -> Sequence[Line]:
        owed, member.asked = member.asked, member.actor.look.remote()
        with suppress(self._ray.exceptions.RayError):  # a sampler that died can't answer
            return _noted(member, self._ray.get(owed))
        return ()

    def _ended(self, member: _Member) -> Sequence[Line]:
        self._running.remove(member)
        try:
            ended: Ended = self._ray.get(member.run)
        except self._ray.exceptions.RayError as error:
            said = (str(error).strip().splitlines() or [type(error).__name__])[-1].strip()
            self.errors.append(f"{member.name}: {said}")
            return (Line(self.errors[-1], True),)
        lines = _noted(member, ended.look)
        if ended.error is None:
            return lines
        self.errors.append(f"{member.name} on {ended.look.host}: {ended.error}")
        return [*lines, Line(self.errors[-1], True)]


def _noted(member: _Member, look: Look) -> list[Line]:
    """Store the counts in a sampler's report ``look``, and return the report's output lines. The first report of a
    process adds a line that names its machine."""
    lines = list(look.lines)
    if look.start not in member.reports:
        again = bool(member.reports)
        begun = "was started again" if again else "runs"
        lines.insert(0, Line(f"{member.name} {begun} on {look.host}, process {look.process}", again))
    member.reports[look.start] = look.report
    return lines


def amounts(resources: Mapping[str, float]) -> str:
    """Return resources as text in the form of the option ``--ray-resources``."""
    return ", ".join(f"{name}={amount:g}" for name, amount in resources.items())


def _options(resources: Mapping[str, float]) -> dict[str, Any]:
    """Return resources as options of a Ray actor, which has arguments of its own for CPU, GPU and memory."""
    own = {"CPU": "num_cpus", "GPU": "num_gpus", "memory": "memory"}
    options: dict[str, Any] = {own[name]: amount for name, amount in resources.items() if name in own}
    return {"num_cpus": 1, **options, "resources": {name: resources[name] for name in resources if name not in own}}
