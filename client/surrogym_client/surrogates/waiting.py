"""Wait for other processes: for a surrogate to be registered, for queries to be answered, for a design to end.

This module also has the phases in which a design has ended, a test for surrogates whose design waits for a log, and the
check that the budget is large enough for the rounds of a training.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from surrogym_client.errors import ServerUnreachable, SurrogymClientError, UnknownSurrogate
from surrogym_client.transport.api import Api
from surrogym_shared.states import COMPLETED as COMPLETED
from surrogym_shared.states import ENDED as ENDED
from surrogym_shared.states import Phase
from surrogym_shared.wire import SurrogateView
from surrogym_shared.words import counted

IN_WORDS: dict[Phase, str] = {
    "ready": "the design is ready",
    "over_budget": "the design has spent its budget without being certain of its model",
    "unsure": "the design has ended before its budget was spent, without being certain of its model",
    "from_log": "the model is fitted to the log, and the design requests no real steps",
    "failed": "the design has failed",
}


def awaits_log(view: SurrogateView) -> bool:
    """Whether a design waits for the import of a log: its budget is 0, and it has neither samples nor queries."""
    asked = view.queries.pending + view.queries.leased
    return view.budget == 0 and view.model_version is None and not view.samples and not asked


def words_of_no_log(name: str) -> str:
    """Describe the state of a surrogate that waits for a log, with the command that imports one."""
    return f"the design requests no real steps, and there is no log yet; next: surrogym import LOG --to {name}"


class BudgetTooSmall(SurrogymClientError):
    """The budget has too few real steps for the rounds of a training, and the token may not raise it."""


def words_of_rounds(api: Api, name: str, queries: int, rounds: int) -> str:
    """Describe how many real steps the rounds of a training may cost.

    Args:
        api: the server.
        name: name of the surrogate.
        queries: real steps of each round.
        rounds: number of rounds.

    Raises:
        BudgetTooSmall: the budget has fewer steps left, and the token may not raise it.
    """
    view = api.surrogate(name)
    if view.phase == "ready":
        return f"the design of {name!r} is ready: its rounds take no real steps, unless an audit fails"
    needed = queries * rounds
    left = f"the budget of {name!r} has {view.budget_left} of {view.budget} real steps left"
    if needed <= view.budget_left:
        return f"up to {needed} more real steps ({rounds} rounds of {queries}); {left}"
    budget = view.budget + needed - view.budget_left
    if api.access().role == "admin":
        return (
            f"up to {needed} more real steps ({rounds} rounds of {queries}); {left}, and will be raised to at most "
            f"{budget}"
        )
    raise BudgetTooSmall(
        f"{rounds} rounds of {queries} queries need up to {needed} more real steps, and {left}: lower "
        f"--improve or --rounds, or let an admin raise the budget (surrogym change {name} --budget {budget})"
    )


LOOK_SECONDS = 0.25
MANY = 1_500  # number of samples from which the expected time of a fit is shown
# Seconds of a free core for each output in a fit of ``MANY`` to 20,000 samples by the default model: least, if they
# are so noisy that few inducing points stand for all of them; most, with little noise or none.
LEAST_SECONDS, MOST_SECONDS = 1, 30
STARTING_SECONDS = 10.0  # time for a sampler that was started just now to call the server
FIRST_LEASE_SECONDS = 5.0  # time for a sampler to begin a query, which a running sampler does within a second


def share_of_design(view: SurrogateView) -> float:
    """Return how much of a design is done, in [0, 1]: 1 if it has ended, else the share of its budget that is spent."""
    return 1.0 if view.phase in COMPLETED else min(1.0, view.ledger.total / max(1, view.budget))


def words_of_design(view: SurrogateView) -> str:
    """Describe the present state of a design."""
    ledger = view.ledger
    fidelity = "" if view.fidelity is None else f", confidence index {view.fidelity.confidence_index:.4f}"
    taken = f"{ledger.total} of {view.budget} real steps ({ledger.adaptive} adaptive)"
    logged = f"{ledger.logged} logged steps"
    parts = [*([taken] if view.budget or not ledger.logged else []), *([logged] if ledger.logged else [])]
    return f"{', '.join(parts)}{fidelity}{_words_of_fit(view)}"


def words_of_long_fit(view: SurrogateView, seconds: float) -> str:
    """Describe a fit that has taken ``seconds`` so far: its samples, and how long such a fit usually takes."""
    waited = f" for {seconds:.0f} s" if view.phase == "fitting" else ""
    usual = f"; {_usual_seconds(len(view.outputs))}" if waited and view.samples >= MANY else ""
    return f"{words_of_design(view)}{waited}{usual}"


def _usual_seconds(outputs: int) -> str:
    """Describe how long a fit of many samples usually takes, by its number of outputs."""
    return (
        f"{counted(outputs, 'output')} take {outputs * LEAST_SECONDS} to {outputs * MOST_SECONDS} s of a free core, "
        "longest without noise, and several times as long beside other programs"
    )


def words_of_audit(view: SurrogateView) -> str:
    """Describe the present state of an audit: its real steps, and whether the server learns from them."""
    return f"{view.ledger.audit} real steps of audits{_words_of_fit(view)}"


def _words_of_fit(view: SurrogateView) -> str:
    """Return the words that the server is fitting a model; empty if it is not."""
    return f"; a model is being fitted to {view.samples} steps" if view.phase == "fitting" else ""


def words_of_waiting(view: SurrogateView, start: str) -> str:
    """Describe what a training waits for: a sampler (which the command ``start`` starts), the answers of a running
    sampler, or a model."""
    if view.phase == "fitting" and not _under_way(view):
        return words_of_design(view)
    awaited = "the sampler's answers" if view.samplers else f"a sampler ({start})"
    return f"waiting for {awaited}: {words_of_design(view)}"


def words_of_uncertainty(view: SurrogateView) -> str:
    """Describe the end of a design that is not certain of its model."""
    index = "" if view.fidelity is None else f"confidence index {view.fidelity.confidence_index:.4f}, "
    return f"{IN_WORDS[view.phase]}: {index}target {view.target:g}"


class DesignUnfinished(SurrogymClientError):
    """The design has failed, or did not end in time. ``surrogym status`` shows the reason."""


class NobodyAnswers(SurrogymClientError):
    """No sampler has begun to answer the queries that a command waits for."""


def wait_for_surrogate(api: Api, name: str, seconds: float) -> SurrogateView:
    """Wait until the surrogate is registered, and return it.

    Raises:
        UnknownSurrogate: the surrogate was not registered within ``seconds``.
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
    """Wait until the design has ended, because it is ready or can't continue, and return the surrogate.

    Args:
        api: the server; it may be unreachable for a while.
        name: name of the surrogate.
        seconds: longest time to wait.
        progress: called each time the surrogate is polled.
        after_round: the design must have completed more rounds than this.

    Raises:
        DesignUnfinished: the design failed, or did not end within ``seconds``.
        UnknownSurrogate: there is no surrogate of this name.
    """
    view = None
    for view in _looks(api, name, seconds, progress):
        if view is None:
            continue
        if view.phase in COMPLETED and view.round > after_round and not _under_way(view):
            return view
        if view.phase == "failed":
            raise DesignUnfinished(f"the design of {name!r} failed: {view.error}; surrogym status {name} shows more")
    raise DesignUnfinished(
        f"the design of {name!r} has not ended after {seconds:g} s, its phase is {_phase(view)}: see surrogym "
        f"status {name}"
    )


def wait_for_start(api: Api, name: str) -> SurrogateView:
    """Wait a few seconds for a sampler that was started just now, if a design has not begun. Return the surrogate.

    Raises ``UnknownSurrogate`` if there is no surrogate of this name.
    """
    for view in _looks(api, name, STARTING_SECONDS, None):
        if view is not None and (view.samplers or view.samples or view.phase != "collecting" or view.paused):
            break
    return api.surrogate(name)


def wait_for_answers(
    api: Api, name: str, queries: set[int], seconds: float, progress: Callable[[SurrogateView], None] | None = None
) -> None:
    """Wait until samplers have answered the given queries, or given up on them.

    Raises:
        NobodyAnswers: no sampler has begun any of the queries after ``FIRST_LEASE_SECONDS``.
        DesignUnfinished: some of the queries were still open after ``seconds``.
        UnknownSurrogate: there is no surrogate of this name.
    """
    started, begun = time.monotonic(), False
    for view in _looks(api, name, seconds, progress):
        if view is None:
            continue
        wanted = [query for query in api.queries(name) if query.id in queries]
        if all(query.status in ("answered", "set_aside", "refused") for query in wanted):
            return
        begun = begun or view.queries.leased > 0 or any(query.attempts for query in wanted)
        if not begun and time.monotonic() >= started + FIRST_LEASE_SECONDS:
            raise NobodyAnswers(
                f"no sampler has begun a query of {name!r} within {FIRST_LEASE_SECONDS:g} s: start surrogym sample "
                f"{name}"
            )
    raise DesignUnfinished(
        f"{len(queries)} queries of {name!r} were not all answered after {seconds:g} s: see surrogym status {name}"
    )


def wait_for_model(
    api: Api, name: str, seconds: float, progress: Callable[[SurrogateView], None] | None = None
) -> SurrogateView:
    """Wait until the surrogate has a model of all its samples, and return the surrogate. Arguments and errors are those
    of ``wait_for_design``."""
    view = None
    for view in _looks(api, name, seconds, progress):
        if view is None:
            continue
        if view.fidelity is not None and view.fidelity.samples >= view.samples:
            return view
        if view.phase == "failed":
            raise DesignUnfinished(f"the fit of {name!r} failed: {view.error}; surrogym status {name} shows more")
    if view is not None and view.phase == "fitting":
        raise DesignUnfinished(
            f"the fit of {view.samples} steps of {name!r} has not ended after {seconds:g} s; it "
            f"continues on the server, and surrogym status {name} shows the model once it is there"
        )
    raise DesignUnfinished(
        f"there is no model of {name!r} after {seconds:g} s, its phase is {_phase(view)}: see surrogym status {name}"
    )


def _looks(
    api: Api, name: str, seconds: float, progress: Callable[[SurrogateView], None] | None
) -> Iterator[SurrogateView | None]:
    """Poll a surrogate for ``seconds``. Call ``progress`` with each view and yield it; yield None without an answer."""
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


def is_fitting(view: SurrogateView) -> bool:
    """Whether a model is being fitted, or the first one is about to be, because the first queries are answered."""
    due = view.phase == "collecting" and view.samples > 0 and not view.paused and not _under_way(view)
    return due or view.phase == "fitting"


def _under_way(view: SurrogateView) -> bool:
    """Whether a design has open queries, including those that were added after its end."""
    return view.queries.pending + view.queries.leased > 0
