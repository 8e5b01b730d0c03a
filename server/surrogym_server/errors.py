"""The exceptions of the server, as a tree. They don't depend on HTTP: ``api.problems`` maps each leaf to an error code.

SurrogymError
├── InvalidInput            the caller sent something that can't be used; says what was expected and what came
│   ├── InvalidSpec         a specification that contradicts itself, or a task the chosen preset can't represent
│   └── TooLarge            more rows, lanes or bytes than the limit
├── NotThere                the request names a thing that does not exist
│   ├── UnknownSurrogate
│   ├── UnknownQuery
│   ├── UnknownModel
│   ├── UnknownPolicy
│   ├── UnknownJob
│   ├── UnknownSession
│   └── SessionExpired      the session was idle for too long or lost in a crash; open a new one
├── Conflict                the request is well formed but does not fit the present state
│   ├── SpecConflict        the name exists with another specification
│   ├── IdempotencyConflict the same idempotency key came with another body
│   ├── SeqConflict         neither the next seq nor a repeat of the last request; ``expected`` says which
│   ├── ForeignLease        a lease token that was never given out for this query
│   ├── LeaseExpired        renewing or failing under a lease that has ended
│   ├── NotReset            a step before the first reset, or of a finished lane under autoreset disabled
│   └── NoModel             nothing has been fitted yet
├── Refused                 the caller may not do this
│   ├── Unauthenticated     no token, or an unknown one
│   ├── Forbidden           the role of the token does not allow this
│   └── BeyondBudget        more real steps than the budget has left, from a caller who may not raise it
├── Unavailable             storage or engine can't serve this now; try again later
│   ├── Damaged             what is stored can't be read as it was written; whoever runs the server restores a copy
│   ├── Overloaded          a queue or a cap is full; try again later
│   └── DeadlineExceeded    the answer would come after the deadline of the request
├── NotInstalled            a stored surrogate needs a plug-in that this server lacks; whoever runs it installs it
├── PluginFailed            an acquisition or a family of models raised an error or broke its invariants
│   └── ChoiceFailed        an acquisition raised an error; the model was fitted, its next queries were not chosen
└── NumericalFailure        a covariance matrix that no jitter repairs
"""

from __future__ import annotations


class SurrogymError(Exception):
    """Base class of all errors that the server raises on purpose. ``str(error)`` is a sentence for the user."""


class InvalidInput(SurrogymError):
    """The content of a request is invalid; nothing was changed. The message says what was expected and what came."""


class InvalidSpec(InvalidInput):
    """A specification contradicts itself, or the chosen preset can't represent it."""


class TooLarge(InvalidInput):
    """A request exceeds a limit; the message names the limit."""


class NotThere(SurrogymError):
    """A thing that the request names does not exist."""


class UnknownSurrogate(NotThere):
    """The surrogate that a request names does not exist."""


class UnknownQuery(NotThere):
    """The surrogate has no query with the requested id."""


class UnknownModel(NotThere):
    """The surrogate has no model with the requested version."""


class UnknownPolicy(NotThere):
    """The surrogate has no policy of the requested version or alias, or this policy lacks the requested file or
    evaluation."""


class UnknownJob(NotThere):
    """The surrogate has no job with the requested id."""


class UnknownSession(NotThere):
    """There is no session with the requested id."""


class SessionExpired(NotThere):
    """The session was idle for too long, or was lost with a crash; open a new one."""


class Conflict(SurrogymError):
    """The request is well formed but does not fit the present state; nothing was changed."""


class SpecConflict(Conflict):
    """A surrogate of this name exists with another specification."""


class IdempotencyConflict(Conflict):
    """The idempotency key of a request was sent before, with a request of another body."""


class SeqConflict(Conflict):
    """A session's request has a sequence number that is neither the next one (``expected``) nor that of the last
    request, or it has that of the last request and another body."""

    def __init__(self, message: str, expected: int) -> None:
        super().__init__(message)
        self.expected = expected

    def __reduce__(self) -> tuple[type[SeqConflict], tuple[str, int]]:
        return type(self), (str(self), self.expected)


class ForeignLease(Conflict):
    """The lease token of a request does not belong to the query that the request names."""


class LeaseExpired(Conflict):
    """The lease of a query or job has ended; claim the work again."""


class NotReset(Conflict):
    """A lane of a session can't be stepped before it is reset."""


class NoModel(Conflict):
    """The surrogate has no fitted model yet."""


class Refused(SurrogymError):
    """The caller has no permission for the request."""


class Unauthenticated(Refused):
    """The request has no token, or an unknown one."""


class Forbidden(Refused):
    """The role of the request's token does not allow the request."""


class BeyondBudget(Refused):
    """The request needs more real steps than the budget has left; a caller with role admin may raise the budget."""


class Unavailable(SurrogymError):
    """The storage or the engine can't serve the request now; nothing was changed; try again later."""


class Damaged(Unavailable):
    """Stored data differ from what was written. Trying again helps only after a backup was restored."""


class Overloaded(Unavailable):
    """A queue is full or a limit of the server is reached; try again later."""


class DeadlineExceeded(Unavailable):
    """The answer would come after the request's deadline; nothing was computed."""


class NotInstalled(SurrogymError):
    """Stored data need a plug-in that is not installed. Nothing was changed, and reading works without it."""


class PluginFailed(SurrogymError):
    """An acquisition or a family of models raised an error, or its result violates a rule of its interface. The message
    names the acquisition or the family."""


class ChoiceFailed(PluginFailed):
    """An acquisition raised an error, or its result violates a rule of its interface. The model was fitted, but its
    next queries could not be chosen."""


class NumericalFailure(SurrogymError):
    """A covariance matrix is not positive definite, and no jitter on its diagonal repairs it."""
