"""The designer: whenever a surrogate is due, fit it, store model and next queries, wake who waits"""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from typing import Protocol

import numpy as np

from surrogym_server.engine.design_job import DesignJob, DesignResult
from surrogym_server.engine.models import ModelCache
from surrogym_server.errors import (
    Damaged,
    InvalidInput,
    LeaseExpired,
    NotInstalled,
    PluginFailed,
    SurrogymError,
    Unavailable,
    UnknownSurrogate,
)
from surrogym_server.services.definitions import Definitions
from surrogym_server.services.metrics import ProcessMetrics
from surrogym_server.services.notices import Notices
from surrogym_server.storage.port import Storage
from surrogym_server.storage.records import (
    OPEN_STATUSES,
    FitLease,
    Granted,
    NewDesign,
    NewModel,
)
from surrogym_shared.plugins import one_line

logger = logging.getLogger(__name__)

FIT_LEASE_SECONDS = 30.0
RENEWALS_PER_LEASE = 3
ATTEMPTS = 5  # of a fit whose process is killed, or whose result can't be stored


class FitRunner(Protocol):
    """Where jobs are done; ``engine.fits.Fits`` is one."""

    async def run(self, job: DesignJob) -> DesignResult: ...


class Designer:
    def __init__(
        self,
        storage: Storage,
        definitions: Definitions,
        fits: FitRunner,
        models: ModelCache,
        notices: Notices,
        metrics: ProcessMetrics,
        *,
        owner: str,
        threads: int,
        look_seconds: float,
    ) -> None:
        """
        Args:
            storage: holds the right to fit.
            definitions: of the surrogates in it.
            fits: where jobs are done.
            models: told of each new version.
            notices: wake this designer, and are posted after each fit.
            metrics: of this process.
            owner: name of this server in the right to fit.
            threads: of torch in a fit.
            look_seconds: how often to look for what no notice told.
        """
        self._storage = storage
        self._definitions = definitions
        self._fits = fits
        self._models = models
        self._notices = notices
        self._metrics = metrics
        self._owner = owner
        self._threads = threads
        self._look_seconds = look_seconds
        self._unavailable: dict[str, int] = {}  # fits in a row that had no process, or no storage, by surrogate

    async def run(self) -> None:
        """Fit what is due, for ever; ends by cancellation, and what was being fitted stays due."""
        with self._notices.listen() as listener:
            while True:
                try:
                    await self.fit_all_due()
                except Unavailable as error:
                    logger.warning("storage is away or damaged, the design waits: %s", error)
                except Exception:  # one surrogate's trouble must not end the design of all others
                    logger.exception("a look for what is due failed; the next one follows")
                await listener.wait(self._look_seconds)

    async def fit_all_due(self) -> None:
        """Fit every surrogate that is due, one after the other."""
        for name in await asyncio.to_thread(self._storage.designs.due):
            try:
                await self._fit(name)
            except Damaged as error:
                logger.warning("the design of %s waits: %s", name, error)
            except SurrogymError as error:  # deleted or taken by another server meanwhile
                logger.debug("%s is not fitted: %s", name, error)
        await asyncio.to_thread(self._give_up_hopeless)

    def improve(
        self, name: str, queries: int, checkpoint: str | None, key: str | None, *, raise_budget: bool
    ) -> Granted:
        """Ask the next fit for more queries, weighted by the occupancy of a checkpoint (None: the latest, if
        any), and for ``raise_budget`` raise the budget to hold them.

        Raises:
            InvalidInput: no occupancy was submitted under this name.
            BeyondBudget: the budget has not as many left, and may not be raised.
        """
        if checkpoint is not None and self._storage.occupancy.get(name, checkpoint) is None:
            raise InvalidInput(f"no occupancy was submitted as {checkpoint!r}: submit it from a session first")
        if checkpoint is None and (latest := self._storage.occupancy.latest(name)) is not None:
            checkpoint = latest.checkpoint
        granted = self._storage.designs.ask(name, queries, checkpoint=checkpoint, key=key, raise_budget=raise_budget)
        self._notices.post(name)
        return granted

    async def _fit(self, name: str) -> None:
        lease = await asyncio.to_thread(self._storage.designs.begin, name, self._owner, FIT_LEASE_SECONDS)
        if lease is None:
            return
        self._notices.post(name)
        keeper = asyncio.create_task(self._keep(lease))
        try:
            result = await self._fits.run(await asyncio.to_thread(self._job, lease))
            await asyncio.to_thread(self._commit, lease, result)
            self._metrics.fits.observe(result.seconds)
            self._unavailable.pop(name, None)
        except asyncio.CancelledError:
            self._abort(lease, None)
            raise
        except LeaseExpired:
            logger.info("the fit of %s is made again: it was changed, or another server fits it", name)
        except Exception as error:
            self._metrics.failed_fits += 1
            ours = isinstance(error, SurrogymError) and not isinstance(error, PluginFailed)
            logger.warning("the round of %s failed: %s", name, error, exc_info=not ours)
            again = isinstance(error, Unavailable) and self._may_try_again(name)
            await asyncio.to_thread(self._abort, lease, None if again else _failure(name, error))
        finally:
            keeper.cancel()
            self._notices.post(name)

    def _may_try_again(self, name: str) -> bool:
        """Whether a fit that could not be done now stays due; it does for so many attempts in a row."""
        attempts = self._unavailable.pop(name, 0) + 1
        if attempts < ATTEMPTS:
            self._unavailable[name] = attempts
        return attempts < ATTEMPTS

    async def _keep(self, lease: FitLease) -> None:
        while True:
            await asyncio.sleep(FIT_LEASE_SECONDS / RENEWALS_PER_LEASE)
            with suppress(SurrogymError):  # the commit will say so
                await asyncio.to_thread(self._storage.designs.renew, lease, FIT_LEASE_SECONDS)

    def _job(self, lease: FitLease) -> DesignJob:
        name = lease.surrogate
        record, samples = self._storage.surrogates.get(name), self._storage.samples.arrays(name)
        pending = self._storage.queries.list(name, (*OPEN_STATUSES, "set_aside"))
        spoken = len(samples.reward) + sum(query.steps for query in pending)
        steps = [query for query in pending if query.kind == "step"]
        visited = None if lease.checkpoint is None else self._storage.occupancy.get(name, lease.checkpoint)
        return DesignJob(
            definition=self._definitions.for_design(name).with_tolerances(record.tolerances),
            coordinates=samples.coordinates,
            action=samples.action,
            next_coordinates=samples.next_coordinates,
            reward=samples.reward,
            terminated=samples.terminated,
            state=record.state,
            budget=record.budget,
            target=record.target,
            pending_coordinates=np.array([query.coordinates for query in steps]) if steps else None,
            pending_action=np.array([query.action for query in steps]) if steps else None,
            pending_rollouts=tuple(query.actions for query in pending if query.kind == "rollout"),
            extra_queries=min(lease.extra_queries, max(0, record.budget - spoken)),  # it may have been lowered since
            occupancy=None if visited is None else visited.states,
            threads=self._threads,
        )

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
            query_coordinates=result.query_coordinates,
            query_action=result.query_action,
            query_rollouts=result.query_rollouts,
            extra=result.verdict != "continue",
        )
        surrogate = self._storage.surrogates.get(lease.surrogate).id
        version = self._storage.designs.commit(lease, design)
        self._models.publish(surrogate, version)

    def _abort(self, lease: FitLease, error: str | None) -> None:
        with suppress(SurrogymError):
            self._storage.designs.abort(lease, error)

    def _give_up_hopeless(self) -> None:
        """Fail the designs whose initial queries were all set aside: nothing to fit, and nothing to wait for."""
        for name in self._storage.designs.hopeless():
            with suppress(UnknownSurrogate):  # deleted meanwhile
                set_aside = self._storage.queries.list(name, ("set_aside",))
                error = f"all {len(set_aside)} initial queries were set aside; the last said: {set_aside[-1].error}"
                self._storage.surrogates.set_phase(name, "failed", error)
                self._notices.post(name)


def _failure(name: str, error: Exception) -> str:
    """Why a round failed, and what to do about it, for the status of its surrogate."""
    match error:
        case NotInstalled():
            return f"{error}; then: surrogym change {name} --resume"
        case PluginFailed():
            return str(error)
        case SurrogymError():
            return f"the fit failed: {error}"
        case _:
            return f"the fit failed: {one_line(error)}"
