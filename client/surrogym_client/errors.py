"""Errors that requests to a server raise in the client.

SurrogymClientError
├── ServerUnreachable       no answer within the retry budget; the last request may have been carried out
│   └── RequestTimeout      the server took the request and did not answer in time
├── UnusableToken           the token, or the file that should hold it, can't be used; nothing was sent
├── UnusableCertificates    the file of trusted certificates can't be used; nothing was sent
├── ProtocolMismatch        the answer does not follow this version of the protocol
└── ProblemError            the server refused; ``problem`` is its body, and nothing was changed
    ├── InvalidInput        the request can't be used: wrong route, field, shape, type or range
    │   ├── InvalidSpec
    │   └── TooLarge
    ├── NotThere
    │   ├── UnknownSurrogate
    │   ├── UnknownQuery
    │   ├── UnknownModel
    │   ├── UnknownPolicy
    │   ├── UnknownJob
    │   └── SessionLost     the environments open a new session and end the running episodes as truncated
    │       ├── UnknownSession
    │       └── SessionExpired
    ├── Conflict            well formed, but it does not fit the present state
    │   ├── SpecConflict
    │   ├── IdempotencyConflict
    │   ├── SeqConflict     ``expected_seq`` is what the session waits for
    │   ├── ForeignLease
    │   ├── LeaseExpired
    │   ├── NotReset
    │   └── NoModel
    ├── Refused
    │   ├── Unauthenticated
    │   ├── Forbidden
    │   └── BeyondBudget    an admin raises the budget, or fewer real steps are asked for
    ├── Unavailable         the server can't answer now; retries did not help within the retry budget
    │   └── Overloaded
    ├── NotInstalled        the surrogate needs a plug-in that the server lacks; reading works without it
    └── ServerFailure       a defect of the server, or of what it has stored

Every error pickles, so that it can cross from a worker process to its parent.
"""

from __future__ import annotations

from surrogym_shared.codes import STATUS, Code, Problem


class SurrogymClientError(Exception):
    """Base class of all errors of the client. ``str(error)`` is one sentence for a person."""

    way_out = ""  # advice on what to do next; a traceback shows it as a note

    def __init__(self, *args: object) -> None:
        super().__init__(*args)
        if self.way_out:
            self.add_note(f"What to do: {self.way_out}.")


class ServerUnreachable(SurrogymClientError):
    """The server did not answer within the retry budget. Check the address, and that the server runs."""

    way_out = "start one with surrogym serve, or give another address by SURROGYM_URL, --server or url in Python"


class RequestTimeout(ServerUnreachable):
    """The server did not answer in time. The connection was dropped, so a late answer is never read."""

    way_out = "surrogym doctor measures how long it takes to answer"


class UnusableToken(SurrogymClientError):
    """The token can't be sent, or its file can't be read or has no token. Check the token, or its file's only line."""


class UnusableCertificates(SurrogymClientError):
    """The file of trusted certificates, ``SSL_CERT_FILE``, can't be used. Correct its path, or unset the variable."""

    way_out = "correct the path, or unset SSL_CERT_FILE"


class ProtocolMismatch(SurrogymClientError):
    """The address does not belong to a Surrogym server, or its protocol version differs."""

    way_out = "surrogym doctor shows more"


class ProblemError(SurrogymClientError):
    """The server refused the request. ``problem`` has the reason as text and as a code."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem)
        self.problem = problem

    def __str__(self) -> str:
        request = self.problem.request
        return self.problem.detail if request is None else f"{self.problem.detail} [request {request}]"


class InvalidInput(ProblemError):
    """The server can't use the request. The detail says what was expected and what came."""


class InvalidSpec(InvalidInput):
    """The specification contradicts itself."""


class TooLarge(InvalidInput):
    """The request exceeds a limit of the server."""


class NotThere(ProblemError):
    """Something named in the request does not exist."""


class UnknownSurrogate(NotThere):
    """There is no surrogate of this name. Register it first."""

    way_out = "register it first by surrogym register ENVIRONMENT --name NAME; surrogym status lists the existing ones"


class UnknownQuery(NotThere):
    """There is no query of this number."""


class UnknownModel(NotThere):
    """There is no model of this version."""


class UnknownPolicy(NotThere):
    """There is no policy of this version or alias, or it lacks the requested file or evaluation."""


class UnknownJob(NotThere):
    """There is no job of this number."""


class SessionLost(NotThere):
    """The session no longer exists, so its episodes can't continue."""


class UnknownSession(SessionLost):
    """There is no session of this id."""


class SessionExpired(SessionLost):
    """The session was idle for too long, or the server lost it in a crash."""


class Conflict(ProblemError):
    """The request does not fit the server's present state."""


class SpecConflict(Conflict):
    """A surrogate of this name exists with another specification. Choose another name."""


class IdempotencyConflict(Conflict):
    """The idempotency key was used before, with another body."""


class SeqConflict(Conflict):
    """Another client steps this session, or the server carried out a step that this client had given up."""

    @property
    def expected_seq(self) -> int | None:
        return self.problem.expected_seq


class ForeignLease(Conflict):
    """The lease token does not belong to this query."""


class LeaseExpired(Conflict):
    """The lease has expired. Claim a query again."""


class NotReset(Conflict):
    """The lane has to be reset before it can be stepped."""


class NoModel(Conflict):
    """There is no model yet. A sampler has to answer the first queries."""


class Refused(ProblemError):
    """The caller may not send this request."""


class Unauthenticated(Refused):
    """The request has no token, or an unknown one. Set SURROGYM_TOKEN."""

    way_out = "give a token of this server by SURROGYM_TOKEN or --token-file"


class Forbidden(Refused):
    """The role of the token does not allow this request."""

    way_out = "surrogym doctor shows what this token may do"


class BeyondBudget(Refused):
    """The budget has too few real steps left, and this token may not raise it."""


class Unavailable(ProblemError):
    """The server can't answer this request at the moment."""


class Overloaded(Unavailable):
    """A queue or a limit of the server is full."""


class NotInstalled(ProblemError):
    """The surrogate needs a plug-in that the server lacks. Ask the server's operator to install it."""


class ServerFailure(ProblemError):
    """The server has a defect. The server's log says more."""


BY_CODE: dict[Code, type[ProblemError]] = {
    Code.INVALID_REQUEST: InvalidInput,
    Code.INVALID_SPEC: InvalidSpec,
    Code.UNAUTHENTICATED: Unauthenticated,
    Code.FORBIDDEN: Forbidden,
    Code.BEYOND_BUDGET: BeyondBudget,
    Code.NOT_FOUND: InvalidInput,
    Code.UNKNOWN_SURROGATE: UnknownSurrogate,
    Code.UNKNOWN_SESSION: UnknownSession,
    Code.SESSION_EXPIRED: SessionExpired,
    Code.UNKNOWN_QUERY: UnknownQuery,
    Code.UNKNOWN_MODEL: UnknownModel,
    Code.UNKNOWN_POLICY: UnknownPolicy,
    Code.UNKNOWN_JOB: UnknownJob,
    Code.METHOD_NOT_ALLOWED: InvalidInput,
    Code.SPEC_CONFLICT: SpecConflict,
    Code.IDEMPOTENCY_CONFLICT: IdempotencyConflict,
    Code.SEQ_CONFLICT: SeqConflict,
    Code.FOREIGN_LEASE: ForeignLease,
    Code.LEASE_EXPIRED: LeaseExpired,
    Code.NOT_RESET: NotReset,
    Code.NO_MODEL: NoModel,
    Code.TOO_LARGE: TooLarge,
    Code.UNSUPPORTED_MEDIA_TYPE: InvalidInput,
    Code.REQUEST_TIMEOUT: Unavailable,
    Code.TOO_MANY_REQUESTS: Overloaded,
    Code.DEADLINE_EXCEEDED: Unavailable,
    Code.UNAVAILABLE: Unavailable,
    Code.DAMAGED: ServerFailure,
    Code.NOT_INSTALLED: NotInstalled,
    Code.INTERNAL: ServerFailure,
}


def error_from_problem(problem: Problem) -> ProblemError:
    """Return the exception for a problem body."""
    return BY_CODE[problem.code](problem)


def refused_here(code: Code, detail: str) -> ProblemError:
    """Return the exception that the server's refusal would raise, for values that can't be sent, such as NaN."""
    title = code.value.replace("_", " ").capitalize()
    return error_from_problem(Problem(title=title, status=STATUS[code], code=code, detail=detail))
