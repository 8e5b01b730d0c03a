"""The exception tree of the server; it knows no HTTP. ``api.problems`` maps each leaf to one error code.

SurrogymError
├── InvalidInput            the caller sent something that can't be used; says what was expected and what came
│   ├── InvalidSpec         a specification that contradicts itself, or a task the chosen preset can't represent
│   └── TooLarge            more rows, lanes or bytes than the limit
├── NotThere
│   ├── UnknownSurrogate
│   ├── UnknownQuery
│   ├── UnknownModel
│   ├── UnknownPolicy
│   ├── UnknownJob
│   ├── UnknownSession
│   └── SessionExpired      it was there; open a new one
├── Conflict                the request is well formed but does not fit the present state
│   ├── SpecConflict        the name exists with another specification
│   ├── IdempotencyConflict the same key with another body
│   ├── SeqConflict         neither the next seq nor a repeat of the last request; ``expected`` says which
│   ├── ForeignLease        a lease token that was never given out for this query
│   ├── LeaseExpired        renewing or failing under a lease that has ended
│   ├── NotReset            a step before the first reset, or of a finished lane under autoreset disabled
│   └── NoModel             nothing has been fitted yet
├── Refused
│   ├── Unauthenticated
│   ├── Forbidden
│   └── BeyondBudget        more real steps than the budget has left, from a caller who may not raise it
├── Unavailable             storage or engine can't serve this now; try again later
│   ├── Damaged             what is stored can't be read as it was written; whoever runs the server restores a copy
│   ├── Overloaded          a queue or a cap is full; try again later
│   └── DeadlineExceeded    its answer would come after the deadline it brought
├── NotInstalled            a stored surrogate needs a plug-in that this server lacks; whoever runs it installs it
├── PluginFailed            an acquisition or a family of models raised, or gave back what breaks its laws
│   └── ChoiceFailed        an acquisition did: the model could be fitted, its next queries not chosen
└── NumericalFailure        a covariance matrix that no jitter repairs
"""

from __future__ import annotations


class SurrogymError(Exception):
    """Base of all errors that the server raises on purpose. ``str(error)`` is one sentence for a person."""


class InvalidInput(SurrogymError):
    """The content of a request can't be used; nothing was changed."""


class InvalidSpec(InvalidInput):
    """A specification that contradicts itself."""


class TooLarge(InvalidInput):
    """A request exceeds a limit; the message names the limit."""


class NotThere(SurrogymError):
    """A thing that the request names does not exist."""


class UnknownSurrogate(NotThere):
    """No surrogate of this name."""


class UnknownQuery(NotThere):
    """No query of this number."""


class UnknownModel(NotThere):
    """No model of this version."""


class UnknownPolicy(NotThere):
    """No policy with this version or alias, or it lacks the requested file or evaluation."""


class UnknownJob(NotThere):
    """No job of this number."""


class UnknownSession(NotThere):
    """No session of this id."""


class SessionExpired(NotThere):
    """The session was idle for too long, or was lost with a crash; open a new one."""


class Conflict(SurrogymError):
    """The request does not fit the present state; nothing was changed."""


class SpecConflict(Conflict):
    """The name exists with another specification."""


class IdempotencyConflict(Conflict):
    """The same idempotency key came with another body."""


class SeqConflict(Conflict):
    """The seq is neither the next one nor a repeat of the last request."""

    def __init__(self, message: str, expected: int) -> None:
        super().__init__(message)
        self.expected = expected

    def __reduce__(self) -> tuple[type[SeqConflict], tuple[str, int]]:
        return type(self), (str(self), self.expected)


class ForeignLease(Conflict):
    """The lease token was never given out for this query."""


class LeaseExpired(Conflict):
    """The lease has ended; claim again."""


class NotReset(Conflict):
    """A lane has to be reset before it can be stepped."""


class NoModel(Conflict):
    """No model has been fitted yet."""


class Refused(SurrogymError):
    """The caller may not do this."""


class Unauthenticated(Refused):
    """No token, or an unknown one."""


class Forbidden(Refused):
    """The token's role does not allow this."""


class BeyondBudget(Refused):
    """More real steps than the budget has left; a caller with role admin may raise it."""


class Unavailable(SurrogymError):
    """The request can't be served now; nothing was changed; try again later."""


class Damaged(Unavailable):
    """Stored data differ from what was written. Trying again helps only after a copy was restored."""


class Overloaded(Unavailable):
    """A queue or a cap is full; try again later."""


class DeadlineExceeded(Unavailable):
    """The answer would come after the request's deadline; nothing was computed."""


class NotInstalled(SurrogymError):
    """Stored data need a plug-in that is not installed. Nothing was changed, and reading works without it."""


class PluginFailed(SurrogymError):
    """An acquisition or a family of models raised an error or broke its invariants. The message names it."""


class ChoiceFailed(PluginFailed):
    """An acquisition raised an error or broke its invariants. The model was fitted, but its next queries could not be
    chosen."""


class NumericalFailure(SurrogymError):
    """A covariance matrix that no jitter makes positive definite."""
