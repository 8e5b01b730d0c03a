"""Waiting for what another process brings about: a surrogate that is registered, a design that is done."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from surrogym_client.errors import ServerUnreachable, SurrogymClientError, UnknownSurrogate
from surrogym_client.surrogates.phases import COMPLETED
from surrogym_client.transport.api import Api
from surrogym_shared.wire import SurrogateView

LOOK_SECONDS = 0.25
FIRST_LEASE_SECONDS = 5.0  # a sampler that waits for queries begins within a second


def share_of_design(view: SurrogateView) -> float:
    """How much of a design is done, in [0, 1]: all of it when it ended, else by its budget."""
    return 1.0 if view.phase in COMPLETED else min(1.0, view.ledger.total / max(1, view.budget))


def words_of_design(view: SurrogateView) -> str:
    """One look at a design."""
    ledger = view.ledger
    fidelity = "" if view.fidelity is None else f", confidence index {view.fidelity.confidence_index:.4f}"
    taken = f"{ledger.total} of {view.budget} real steps ({ledger.adaptive} adaptive)"
    logged = f"{ledger.logged} logged steps"
    if not ledger.logged:
        return f"{taken}{fidelity}"
    return f"{taken}, {logged}{fidelity}" if view.budget else f"{logged}{fidelity}"


class DesignUnfinished(SurrogymClientError):
    """The design has failed, or was not done in time; ``surrogym status`` says more."""


class NobodyAnswers(SurrogymClientError):
    """No sampler takes the queries that were asked."""


def wait_for_surrogate(api: Api, name: str, seconds: float) -> SurrogateView:
    """The surrogate, once it is registered.

    Raises:
        UnknownSurrogate: it was not within ``seconds``.
    """
    deadline = time.monotonic() + seconds
    while True:
        try:
            return api.surrogate(name)
        except UnknownSurrogate:
            if time.monotonic() >= deadline:
                raise
            time.sleep(LOOK_SECONDS)


def wait_for_design(
    api: Api,
    name: str,
    seconds: float,
    progress: Callable[[SurrogateView], None] | None = None,
    *,
    after_round: int = 0,
) -> SurrogateView:
    """The surrogate, once its design has reached the target or the budget.

    Args:
        api: the server; it may be away for a while.
        name: the surrogate.
        seconds: how long to wait.
        progress: called with every look.
        after_round: the design counts as done only when it has had more rounds than these.

    Raises:
        DesignUnfinished: the design failed, or was not done within ``seconds``.
        UnknownSurrogate: there is none of this name.
    """
    view = None
    for view in _looks(api, name, seconds, progress):
        if view is None:
            continue
        if view.phase in COMPLETED and view.round > after_round and not _under_way(view):
            return view
        if view.phase == "failed":
            raise DesignUnfinished(f"the design of {name!r} failed: {view.error}")
    raise DesignUnfinished(f"the design of {name!r} was not done after {seconds:g} s: its phase is {_phase(view)}")


def wait_for_answers(
    api: Api, name: str, queries: set[int], seconds: float, progress: Callable[[SurrogateView], None] | None = None
) -> None:
    """Wait until samplers have answered these queries, or given up on them.

    Raises:
        NobodyAnswers: no sampler has begun any of them after ``FIRST_LEASE_SECONDS``.
        DesignUnfinished: some were still open after ``seconds``.
        UnknownSurrogate: there is none of this name.
    """
    started, begun = time.monotonic(), False
    for view in _looks(api, name, seconds, progress):
        if view is None:
            continue
        wanted = [query for query in api.queries(name) if query.id in queries]
        if all(query.status in ("answered", "set_aside") for query in wanted):
            return
        begun = begun or view.queries.leased > 0 or any(query.attempts for query in wanted)
        if not begun and time.monotonic() >= started + FIRST_LEASE_SECONDS:
            raise NobodyAnswers(f"no sampler has begun a query of {name!r} within {FIRST_LEASE_SECONDS:g} s")
    raise DesignUnfinished(f"{len(queries)} queries of {name!r} were not all answered after {seconds:g} s")


def wait_for_model(
    api: Api, name: str, seconds: float, progress: Callable[[SurrogateView], None] | None = None
) -> SurrogateView:
    """The surrogate, once it has a model of all its samples. Arguments and errors as of ``wait_for_design``."""
    view = None
    for view in _looks(api, name, seconds, progress):
        if view is None:
            continue
        if view.fidelity is not None and view.fidelity.samples >= view.samples:
            return view
        if view.phase == "failed":
            raise DesignUnfinished(f"the fit of {name!r} failed: {view.error}")
    raise DesignUnfinished(f"there was no model of {name!r} after {seconds:g} s: its phase is {_phase(view)}")


def _looks(
    api: Api, name: str, seconds: float, progress: Callable[[SurrogateView], None] | None
) -> Iterator[SurrogateView | None]:
    """Look at a surrogate again and again for ``seconds``, and show it; None where the server was away."""
    deadline = time.monotonic() + seconds
    while True:
        view = _look(api, name, deadline)
        if view is not None and progress is not None:
            progress(view)
        yield view
        if time.monotonic() >= deadline:
            return
        time.sleep(LOOK_SECONDS)


def _phase(view: SurrogateView | None) -> str:
    return "unknown" if view is None else view.phase


def _look(api: Api, name: str, deadline: float) -> SurrogateView | None:
    try:
        return api.surrogate(name)
    except ServerUnreachable:
        if time.monotonic() >= deadline:
            raise
        return None


def _under_way(view: SurrogateView) -> bool:
    """Queries that were asked for after the design was done."""
    return view.queries.pending + view.queries.leased > 0
