"""The designer: fits a model to the samples of each surrogate that needs a new one, stores the model and the next
queries, and wakes waiting samplers."""

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
from surrogym_server.services.definitions import Definitions, check_trial
from surrogym_server.services.metrics import ProcessMetrics
from surrogym_server.services.notices import Notices
from surrogym_server.services.surrogates import Plan
from surrogym_server.storage.records import (
    FREE,
    OPEN_STATUSES,
    FitLease,
    Granted,
    NewDesign,
    NewModel,
)
from surrogym_server.storage.sql import Storage
from surrogym_shared.nouns import Query

logger = logging.getLogger(__name__)

FIT_LEASE_SECONDS = 30.0
RENEWALS_PER_LEASE = 3
ATTEMPTS = 5  # a fit is tried this many times if its process dies or its result can't be stored, then counts as failed
LONG_SECONDS = 60.0  # if a fit runs longer than this, a warning is logged
# A fit that runs longer than this frees its place among the ``fit_workers`` fits that run at the same time.
PASSED_SECONDS = 5.0
MOST_PASSED = 3  # at most this many long fits run in addition to the ``fit_workers`` others, each in its own process
PAUSE_SECONDS = 1.0  # a running fit renews its lease at most once in this many seconds


class _Turn:
    """Place of a fit among the limited number of fits that run at the same time. ``let_others_pass`` exchanges it for
    one of the places for long fits, so that another fit can start."""

    def __init__(self, usual: asyncio.Semaphore, passed: asyncio.Semaphore) -> None:
        self._usual, self._passed, self._current = usual, passed, usual

    async def __aenter__(self) -> _Turn:
        await self._usual.acquire()
        return self

    async def __aexit__(self, *_: object) -> None:
        self._current.release()

    async def let_others_pass(self) -> None:
        """Wait for ``PASSED_SECONDS``, and until fewer than ``MOST_PASSED`` long fits run. Then free the fit's usual
        place for another fit."""
        await asyncio.sleep(PASSED_SECONDS)
        await self._passed.acquire()
        self._current = self._passed
        self._usual.release()


@dataclass(frozen=True)
class DesignerSettings:
    """Settings of a ``Designer``.

    Attributes:
        owner: name of this server in the lease of a fit.
        threads: number of torch threads in a fit.
        look_seconds: time between searches for surrogates that need a fit, in case no notice announced them.
        fit_seconds: a fit that takes longer is stopped and counts as failed.
        fit_workers: number of fits that run at a time, long ones not counted.
    """

    owner: str
    threads: int
    look_seconds: float
    fit_seconds: float
    fit_workers: int = 1


class Designer:
    """Fits each surrogate that is due, which means that a new model has to be fitted. Each fit runs under a lease,
    which only one server can hold at a time."""

    def __init__(  # not grouped into one object, because each parameter comes from a different part of the server
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
        """Keep the objects of the server that fits need.

        Args:
            storage: stores surrogates, samples and models, and the leases of fits.
            definitions: environment definitions of the stored surrogates.
            plan: function that returns the first queries of a design, given its budget.
            fits: computes the jobs.
            models: cache that gets the version of each new model.
            notices: wake this designer; it posts a notice after each fit.
            metrics: counters of this process.
            settings: how often to search for due surrogates, and how long and how many fits may run.
        """
        self._storage = storage
        self._definitions = definitions
        self._plan = plan
        self._fits = fits
        self._models = models
        self._notices = notices
        self._metrics = metrics
        self._settings = settings
        self._usual, self._passed = asyncio.Semaphore(settings.fit_workers), asyncio.Semaphore(MOST_PASSED)
        self._tasks: dict[str, asyncio.Task[None]] = {}  # the running or waiting fit of each surrogate, by its name
        # Number of successive fits of a surrogate, by its name, whose process died or whose result was not stored.
        self._unavailable: dict[str, int] = {}

    async def run(self) -> None:
        """Fit surrogates as they become due, until cancelled. A surrogate whose fit is cancelled stays due."""
        try:
            with self._notices.listen() as listener:
                while True:
                    try:
                        await self._begin_all_due()
                    except Unavailable as error:
                        logger.warning("the storage is unavailable or damaged, so the design waits: %s", error)
                    except Exception:  # any error is logged, so that fits of other surrogates continue
                        logger.exception("the search for due fits failed; it is repeated shortly")
                    await listener.wait(self._settings.look_seconds)
        finally:
            tasks = list(self._tasks.values())
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def fit_all_due(self) -> None:
        """Fit a new model for each surrogate that is due (needs one), and return when all fits have ended."""
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
        """Wait for a place, then fit the surrogate ``name``. Errors are logged and end this fit only."""
        try:
            async with _Turn(self._usual, self._passed) as turn:
                await self._fit(name, turn)
        except Damaged as error:
            logger.warning("the design of %s waits: %s", name, error)
        except SurrogymError as error:  # surrogate deleted or fitted by another server, or the storage does not answer
            logger.debug("%s is not fitted: %s", name, error)
        except Exception:
            logger.exception("the fit of %s could not be started or finished; it is tried again shortly", name)
        finally:
            del self._tasks[name]

    def improve(
        self,
        name: str,
        queries: int | Query,
        checkpoint: str | None,
        key: str | None,
        *,
        raise_budget: bool,
    ) -> Granted:
        """Request that the next fit of the surrogate ``name`` chooses more queries, or a trial of a policy.

        Args:
            name: name of the surrogate.
            queries: number of real steps of these queries; or the trial, a query in which a policy acts.
            checkpoint: name of the submitted occupancy (visited states) that weights the queries; None for the latest
                one, if any.
            key: idempotency key of the request.
            raise_budget: whether to raise the budget as far as the queries need.

        Raises:
            InvalidInput: no occupancy was submitted under the name ``checkpoint``, or the trial does not fit the
                surrogate.
            BeyondBudget: the budget has too few real steps left, and ``raise_budget`` is False.
        """
        if checkpoint is not None and self._storage.occupancy.get(name, checkpoint) is None:
            raise InvalidInput(
                f"checkpoint: expected the name under which a session submitted its visited states, got "
                f"{checkpoint!r}: submit them first"
            )
        if checkpoint is None and (latest := self._storage.occupancy.latest(name)) is not None:
            checkpoint = latest.checkpoint
        if isinstance(queries, Query):
            queries = check_trial(self._definitions.get(name), queries)
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
        """Count one more fit of the surrogate ``name`` whose process died or whose result could not be stored. Return
        whether there were fewer than ``ATTEMPTS`` such fits in succession, so that the fit may be repeated."""
        attempts = self._unavailable.pop(name, 0) + 1
        if attempts < ATTEMPTS:
            self._unavailable[name] = attempts
        return attempts < ATTEMPTS

    async def _result(self, lease: FitLease, turn: _Turn) -> DesignResult:
        """Compute the design job of a leased fit, and return its result.

        The job is stopped if it takes longer than ``fit_seconds``, loses its lease, or its surrogate is deleted.

        Raises:
            LeaseExpired: another server has the lease.
            UnknownSurrogate: the surrogate was deleted.
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
                f"a fit of the model family {family!r} took longer than {self._settings.fit_seconds:g} s, and was "
                "stopped: surrogym serve --fit-seconds sets a longer limit"
            )
        finally:
            for task in (work, keeper, passing):
                task.cancel()
            await asyncio.gather(work, keeper, passing, return_exceptions=True)

    async def _keep(self, lease: FitLease) -> None:
        """Renew the lease of a fit until cancelled, and log a warning if the fit takes long.

        Raises:
            LeaseExpired: another server has the lease.
            UnknownSurrogate: the surrogate was deleted.
        """
        began, tell_after = time.monotonic(), LONG_SECONDS
        with self._notices.listen(lease.surrogate) as listener:
            while True:
                await listener.wait(FIT_LEASE_SECONDS / RENEWALS_PER_LEASE)
                try:
                    await asyncio.to_thread(self._storage.designs.renew, lease, FIT_LEASE_SECONDS)
                except (LeaseExpired, UnknownSurrogate):
                    raise
                except SurrogymError as error:  # not raised: if it persists, storing the fit's result raises it again
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
            # Limited by the rest of the budget, because the budget may have been lowered since the extra queries were
            # requested.
            extra_queries=min(lease.extra_queries, max(0, record.budget - spoken)),
            occupancy=None if visits is None else visits.states,
            threads=self._settings.threads,
            prior=self._storage.priors.blob(name),
            previous=self._previous(name) if set(samples.purpose).difference(UNCHOSEN) else None,
        )

    def _previous(self, name: str) -> bytes | None:
        """Return the file of the surrogate's newest model; None if there is no model, or if it is damaged."""
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
        """Set the designs of the surrogates named in ``hopeless`` to "failed". Samplers answered none of their initial
        queries. All were refused by the environment, or set aside after repeated failures, so no sample will come."""
        for name in hopeless:
            with suppress(UnknownSurrogate):  # the surrogate may have been deleted since ``hopeless`` was read
                set_aside = self._storage.queries.list(name, ("set_aside", "refused"))
                refused = all(query.status == "refused" for query in set_aside)
                how = "refused by the original environment" if refused else "set aside"
                error = f"all {len(set_aside)} initial queries were {how}; the last error was: {set_aside[-1].error}"
                self._storage.surrogates.set_phase(name, "failed", error)
                self._notices.post(name)

    def _ask_first(self, unbegun: Sequence[str]) -> None:
        """Queue the initial queries of the surrogates named in ``unbegun``, which were created without a budget and
        have one now."""
        for name in unbegun:
            with suppress(SurrogymError):  # the surrogate may have been deleted, or the storage does not answer
                budget = self._storage.surrogates.get(name).budget
                self._storage.designs.ask_first(name, self._plan(self._definitions.get(name), budget))
                self._notices.post(name)


def _failure(name: str, error: Exception) -> str:
    """Return the text for the surrogate's status that says why its fit failed and what to do."""
    match error:
        case NotInstalled():
            return f"{error}; then: surrogym change {name} --resume"
        case ChoiceFailed():
            return in_one_line(error)
        case _:
            return f"the fit failed: {in_one_line(error)}"
