"""Checks that a server follows the protocol, made through its API. One small surrogate is created, used and deleted."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from surrogym_client.errors import SurrogymClientError
from surrogym_sampler.diagnosis.conformance import checks
from surrogym_sampler.diagnosis.conformance.target import Target
from surrogym_sampler.diagnosis.outcomes import Mismatch, Outcome

Check = Callable[[Target], None]


def conformance(url: str | None, token: str | None, surrogate: str) -> Iterator[Outcome]:
    """Run every check of a server in turn, and yield its outcome.

    Args:
        url: the server's address; default ``SURROGYM_URL``, then http://127.0.0.1:8000.
        token: a token of the role admin, if the server requires tokens.
        surrogate: an unused name on the server; the surrogate is deleted at the end.

    Raises:
        SurrogymClientError: the name is taken, or the surrogate gets no model, so that sessions can't be checked.
    """
    with Target(url, token, surrogate) as target:
        for check in checks.WITHOUT_MODEL:
            yield _outcome(check, target)
        target.teach()
        for check in checks.WITH_MODEL:
            yield _outcome(check, target)


def _outcome(check: Check, target: Target) -> Outcome:
    name = check.__name__.replace("_", " ")
    try:
        check(target)
    except (Mismatch, SurrogymClientError) as failure:
        return Outcome(name, str(failure))
    # raised by reading a reply that lacks fields of the protocol
    except (LookupError, TypeError, ValueError) as failure:
        return Outcome(name, f"expected a reply that follows the protocol, got one that causes {failure!r}")
    return Outcome(name, None)
