"""The designer: fits every surrogate that is due, stores the model and the next queries, and wakes waiting samplers."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from surrogym_server.engine.design_job import UNCHOSEN, DesignJob, DesignResult
from surrogym_server.engine.models import ModelCache
from surrogym_server.engine.port import Compute
from surrogym_server.errors import (
    ChoiceFailed,
    Damaged,
    InvalidInput,
    LeaseExpired,
    NoModel,
    NotInstalled,
    PluginFailed,
    SurrogymError,
    Unavailable,
    UnknownSurrogate,
)
from surrogym_server.plugins import in_one_line
from surrogym_server.services.definitions import Definitions
from surrogym_server.services.metrics import ProcessMetrics
from surrogym_server.services.notices import Notices
from surrogym_server.services.surrogates import Plan
from surrogym_server.storage.port import Storage
from surrogym_server.storage.records import (
    FREE,
    OPEN_STATUSES,
    FitLease,
    Granted,
    NewDesign,
    NewModel,
)

logger = logging.getLogger(__name__)

FIT_LEASE_SECONDS = 30.0
RENEWALS_PER_LEASE = 3
ATTEMPTS = 5  # most attempts at a fit whose process died, or whose result could not be stored
LONG_SECONDS = 60.0  # the log names a fit that takes longer
PASSED_SECONDS = 5.0  # after this time, another fit may start beside a fit
MOST_PASSED = 3  # most long fits that don't count towards ``fit_workers``; each is a process
PAUSE_SECONDS = 1.0  # time between two checks whether a fit is still wanted


class _Turn:
    """A turn to fit: a few fits run at a time. A long fit lets others start beside it."""

    def __init__(self, usual: asyncio.Semaphore, passed: asyncio.Semaphore) -> None:
        self._usual, self._passed, self._current = usual, passed, usual

    async def __aenter__(self) -> _Turn:
        await self._usual.acquire()
        return self

    async def __aexit__(self, *_: object) -> None:
        self._current.release()

    async def let_others_pass(self) -> None:
        """Let other fits start beside this one after a while, as soon as there are few long ones."""
        await asyncio.sleep(PASSED_SECONDS)
        await self._passed.acquire()
        self._current = self._passed
        self._usual.release()


@dataclass(frozen=True)
class DesignerSettings:
    """Settings of a ``Designer``.

    Attributes:
        owner: name of this server in the right to fit.
        threads: number of torch's threads in a fit.
        look_seconds: interval of searches for surrogates that became due without a notice.
        fit_seconds: a fit that takes longer is stopped and counts as failed.
        fit_workers: number of fits at a time, not counting long ones.
    """

    owner: str
    threads: int
    look_seconds: float
    fit_seconds: float
    fit_workers: int = 1


class Designer:
    """Fits the surrogates that are due, each under a right that no other server has at the same time."""

    def __init__(  # eight parameters: seven parts of the server that a fit reads or informs, and the settings
        self,
        storage: Storage,
        definitions: Definitions,
        plan: Plan,
        fits: Compute,
        models: ModelCache,
        notices: Notices,
        metrics: ProcessMetrics,
        settings: DesignerSettings,
    ) -> None:
        """Args:
        storage: holds the right to fit.
        definitions: definitions of the surrogates in the storage.
        plan: function that returns the first queries of a design, given its budget.
        fits: runs the jobs.
        models: is informed of each new version.
        notices: wake this designer, and are posted after each fit.
        metrics: counters of this process.
        settings: how often to look for due surrogates, and how long and how many fits may run."""
        self._storage = storage
        self._definitions = definitions
        self._plan = plan
        self._fits = fits
        self._models = models
        self._notices = notices
        self._metrics = metrics
        self._settings = settings
        self._usual, self._passed = asyncio.Semaphore(settings.fit_workers), asyncio.Semaphore(MOST_PASSED)
        self._tasks: dict[str, asyncio.Task[None]] = {}  # fits that run or wait for their turn, by surrogate
        self._unavailable: dict[str, int] = {}  # fits in succession that lacked a process or storage, by surrogate

    async def run(self) -> None:
        """Fit due surrogates until cancelled. Surrogates whose fit is cancelled stay due."""
        try:
            with self._notices.listen() as listener:
                while True:
                    try:
                        await self._begin_all_due()
                    except Unavailable as error:
                        logger.warning("the storage is unavailable or damaged, so the design waits: %s", error)
                    except Exception:  # an error of one surrogate must not end the fits of all others
                        logger.exception("the search for due fits failed; it is repeated shortly")
                    await listener.wait(self._settings.look_seconds)
        finally:
            tasks = list(self._tasks.values())
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def fit_all_due(self) -> None:
        """Fit every surrogate that is due, and return when all of them are."""
        await self._begin_all_due()
        await asyncio.gather(*self._tasks.values())

    async def _begin_all_due(self) -> None:
        designs = self._storage.designs
        due, hopeless, unbegun = await asyncio.to_thread(lambda: (designs.due(), designs.hopeless(), designs.unbegun()))
        for name in due:
            if name not in self._tasks:
                self._tasks[name] = asyncio.create_task(self._fit_in_turn(name))
        if hopeless:
            await asyncio.to_thread(self._give_up, hopeless)
        if unbegun:
            await asyncio.to_thread(self._ask_first, unbegun)

    async def _fit_in_turn(self, name: str) -> None:
        """Run one fit. Its errors end this fit only."""
        try:
            async with _Turn(self._usual, self._passed) as turn:
                await self._fit(name, turn)
        except Damaged as error:
            logger.warning("the design of %s waits: %s", name, error)
        except SurrogymError as error:  # deleted or taken by another server meanwhile, or the storage is away
            logger.debug("%s is not fitted: %s", name, error)
        except Exception:
            logger.exception("the fit of %s could not be started or finished; it is tried again shortly", name)
        finally:
            del self._tasks[name]

    def improve(
        self, name: str, queries: int, checkpoint: str | None, key: str | None, *, raise_budget: bool
    ) -> Granted:
        """Request more queries from the next fit.

        The queries are weighted by the occupancy of a checkpoint (None: the latest, if any). With ``raise_budget`` the
        budget is raised as far as the queries need.

        Raises:
            InvalidInput: no occupancy was submitted under this name.
            BeyondBudget: the budget has too few real steps left, and may not be raised.
        """
        if checkpoint is not None and self._storage.occupancy.get(name, checkpoint) is None:
            raise InvalidInput(
                f"expected the name of a submitted occupancy, got {checkpoint!r}: submit it from a session first"
            )
        if checkpoint is None and (latest := self._storage.occupancy.latest(name)) is not None:
            checkpoint = latest.checkpoint
        granted = self._storage.designs.improve(
            name, queries, checkpoint=checkpoint, key=key, raise_budget=raise_budget
        )
        self._notices.post(name)
        return granted

    async def _fit(self, name: str, turn: _Turn) -> None:
        lease = await asyncio.to_thread(self._storage.designs.begin, name, self._settings.owner, FIT_LEASE_SECONDS)
        if lease is None:
            return
        self._notices.post(name)
        try:
            result = await self._result(lease, turn)
            await asyncio.to_thread(self._commit, lease, result)
            self._metrics.fits.observe(result.seconds)
            self._unavailable.pop(name, None)
        except asyncio.CancelledError:
            self._abort(lease, None)
            raise
        except (LeaseExpired, UnknownSurrogate):
            logger.info("the fit of %s is dropped: it was deleted or changed, or another server fits it", name)
        except Exception as error:
            self._metrics.failed_fits += 1
            surprise = hasattr(error, "__notes__") or not isinstance(error, SurrogymError)
            logger.warning("the round of %s failed: %s", name, in_one_line(error), exc_info=surprise)
            again = isinstance(error, Unavailable) and self._may_try_again(name)
            await asyncio.to_thread(self._abort, lease, None if again else _failure(name, error))
        finally:
            self._notices.post(name)

    def _may_try_again(self, name: str) -> bool:
        """Whether a fit that could not run now stays due. It does for a limited number of consecutive attempts."""
        attempts = self._unavailable.pop(name, 0) + 1
        if attempts < ATTEMPTS:
            self._unavailable[name] = attempts
        return attempts < ATTEMPTS

    async def _result(self, lease: FitLease, turn: _Turn) -> DesignResult:
        """Run the job of a lease, and return its result. The job is stopped if its result is not wanted any more,
        because another server has the right to fit or the surrogate was deleted, or if it takes too long.

        Raises:
            LeaseExpired, UnknownSurrogate: the result is not wanted any more.
            PluginFailed: the job took too long.
            Exception: any error of the job.
        """
        job = await asyncio.to_thread(self._job, lease)
        work = asyncio.create_task(self._fits.run(job))
        keeper = asyncio.create_task(self._keep(lease))
        passing = asyncio.create_task(turn.let_others_pass())
        try:
            await asyncio.wait({work, keeper}, timeout=self._settings.fit_seconds, return_when=asyncio.FIRST_COMPLETED)
            if work.done():
                return work.result()
            if keeper.done():
                keeper.result()
            family = job.definition.learning.model.name
            raise PluginFailed(
                f"the model family {family!r} took longer than {self._settings.fit_seconds:g} s, and was stopped: "
                "surrogym serve --fit-seconds sets a longer limit"
            )
        finally:
            for task in (work, keeper, passing):
                task.cancel()
            await asyncio.gather(work, keeper, passing, return_exceptions=True)

    async def _keep(self, lease: FitLease) -> None:
        """Renew the right to fit while the fit is wanted, and log a long fit. Raises ``LeaseExpired`` or
        ``UnknownSurrogate`` if the fit is not wanted any more."""
        began, tell_after = time.monotonic(), LONG_SECONDS
        with self._notices.listen(lease.surrogate) as listener:
            while True:
                await listener.wait(FIT_LEASE_SECONDS / RENEWALS_PER_LEASE)
                try:
                    await asyncio.to_thread(self._storage.designs.renew, lease, FIT_LEASE_SECONDS)
                except (LeaseExpired, UnknownSurrogate):
                    raise
                except SurrogymError as error:  # the commit will raise it
                    logger.debug("the right to fit %s is not renewed: %s", lease.surrogate, error)
                if (took := time.monotonic() - began) > tell_after:
                    tell_after *= 2
                    name, most = lease.surrogate, self._settings.fit_seconds
                    logger.warning(
                        "the fit of %s has been running for %.0f s, and is stopped after %g s", name, took, most
                    )
                await asyncio.sleep(PAUSE_SECONDS)

    def _job(self, lease: FitLease) -> DesignJob:
        name = lease.surrogate
        record, samples = self._storage.surrogates.get(name), self._storage.samples.arrays(name)
        unanswered = self._storage.queries.list(name, (*OPEN_STATUSES, "set_aside", "refused"))
        unanswered = [query for query in unanswered if query.purpose not in FREE]
        pending = [query for query in unanswered if query.status != "refused"]
        refused = [query for query in unanswered if query.status == "refused"]
        spoken = sum(purpose not in FREE for purpose in samples.purpose) + sum(query.steps for query in pending)
        visits = None if lease.checkpoint is None else self._storage.occupancy.get(name, lease.checkpoint)
        definition = self._definitions.for_design(name).with_tolerances(record.tolerances)
        return DesignJob(
            definition=definition,
            samples=samples,
            state=record.state,
            budget=record.budget,
            target=record.target,
            pending=tuple(pending),
            open_steps=sum(query.steps for query in pending if query.status != "set_aside"),
            refused=tuple(refused),
            snapshots=self._storage.snapshots.all(name) if definition.snapshots else {},
            extra_queries=min(
                lease.extra_queries, max(0, record.budget - spoken)
            ),  # the budget may have been lowered since
            occupancy=None if visits is None else visits.states,
            threads=self._settings.threads,
            prior=self._storage.priors.blob(name),
            previous=self._previous(name) if set(samples.purpose).difference(UNCHOSEN) else None,
        )

    def _previous(self, name: str) -> bytes | None:
        """Return the newest model as bytes; None if there is none, or if it is damaged."""
        try:
            return self._storage.models.blob(name)
        except (NoModel, Damaged):
            return None

    def _commit(self, lease: FitLease, result: DesignResult) -> None:
        model = NewModel(
            samples=int(result.fidelity["samples"]),
            data_hash=result.data_hash,
            fidelity=result.fidelity,
            description=result.description,
            fit_seconds=result.seconds,
            blob=result.model,
        )
        design = NewDesign(
            model=model,
            state=result.state,
            phase=result.phase,
            queries=result.queries,
            extra=result.verdict != "continue",
        )
        surrogate = self._storage.surrogates.get(lease.surrogate).id
        version = self._storage.designs.commit(lease, design)
        self._models.publish(surrogate, version)

    def _abort(self, lease: FitLease, error: str | None) -> None:
        with suppress(SurrogymError):
            self._storage.designs.abort(lease, error)

    def _give_up(self, hopeless: Sequence[str]) -> None:
        """Fail the designs whose initial queries were all set aside, because they have nothing to fit or to
        wait for."""
        for name in hopeless:
            with suppress(UnknownSurrogate):  # deleted meanwhile
                set_aside = self._storage.queries.list(name, ("set_aside", "refused"))
                refused = all(query.status == "refused" for query in set_aside)
                how = "refused by the original environment" if refused else "set aside"
                error = f"all {len(set_aside)} initial queries were {how}; the last error was: {set_aside[-1].error}"
                self._storage.surrogates.set_phase(name, "failed", error)
                self._notices.post(name)

    def _ask_first(self, unbegun: Sequence[str]) -> None:
        """Queue initial queries of designs that got a budget after they had been created without one."""
        for name in unbegun:
            with suppress(SurrogymError):  # deleted meanwhile, or the storage is away
                budget = self._storage.surrogates.get(name).budget
                self._storage.designs.ask_first(name, self._plan(self._definitions.get(name), budget))
                self._notices.post(name)


def _failure(name: str, error: Exception) -> str:
    """Reason why a round failed, and the way out, for the status of its surrogate."""
    match error:
        case NotInstalled():
            return f"{error}; then: surrogym change {name} --resume"
        case ChoiceFailed():
            return in_one_line(error)
        case _:
            return f"the fit failed: {in_one_line(error)}"
