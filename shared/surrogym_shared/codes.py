"""Error codes of the service and the problem body that carries them (RFC 9457)."""

from __future__ import annotations

from enum import StrEnum

from pydantic import BaseModel, ConfigDict, Field

PROBLEM_MEDIA_TYPE = "application/problem+json"


class Code(StrEnum):
    """Error codes, one for each kind of error. ``STATUS`` has the HTTP status of each."""

    INVALID_REQUEST = "invalid_request"  # malformed body, unknown field, wrong shape or type, NaN, out of bounds
    INVALID_SPEC = "invalid_spec"  # a specification that contradicts itself
    UNAUTHENTICATED = "unauthenticated"  # no token, or an unknown one
    FORBIDDEN = "forbidden"  # the token's role does not allow this request
    BEYOND_BUDGET = "beyond_budget"  # the request needs more real steps than the budget has left
    NOT_FOUND = "not_found"  # no such route
    UNKNOWN_SURROGATE = "unknown_surrogate"
    UNKNOWN_SESSION = "unknown_session"
    SESSION_EXPIRED = "session_expired"  # the session was idle for too long, or was lost in a crash
    UNKNOWN_QUERY = "unknown_query"
    UNKNOWN_MODEL = "unknown_model"
    UNKNOWN_POLICY = "unknown_policy"  # no such version or alias, or the policy has no such file or evaluation
    UNKNOWN_JOB = "unknown_job"
    METHOD_NOT_ALLOWED = "method_not_allowed"
    SPEC_CONFLICT = "spec_conflict"  # a surrogate of this name exists with another specification
    IDEMPOTENCY_CONFLICT = "idempotency_conflict"  # an earlier request with the same idempotency key had another body
    # The number ``seq`` of a session's request is neither the next one nor that of the last request.
    SEQ_CONFLICT = "seq_conflict"
    FOREIGN_LEASE = "foreign_lease"  # the lease token does not belong to a lease of the query
    LEASE_EXPIRED = "lease_expired"  # a lease, of a query or of a job, has ended before the request that names it
    NOT_RESET = "not_reset"  # a step before the first reset, or of a lane whose episode ended, with autoreset disabled
    NO_MODEL = "no_model"  # the surrogate has no model yet
    TOO_LARGE = "too_large"
    UNSUPPORTED_MEDIA_TYPE = "unsupported_media_type"
    REQUEST_TIMEOUT = "request_timeout"  # the body of the request did not arrive in time
    TOO_MANY_REQUESTS = "too_many_requests"  # a queue or a limit of the server is full
    # The reply to a step would have come after the caller's deadline, so no step was taken.
    DEADLINE_EXCEEDED = "deadline_exceeded"
    UNAVAILABLE = "unavailable"
    DAMAGED = "damaged"  # stored data are corrupt
    NOT_INSTALLED = "not_installed"  # stored data needs a plug-in that the server lacks
    INTERNAL = "internal"


STATUS: dict[Code, int] = {
    Code.INVALID_REQUEST: 422,
    Code.INVALID_SPEC: 422,
    Code.UNAUTHENTICATED: 401,
    Code.FORBIDDEN: 403,
    Code.BEYOND_BUDGET: 403,
    Code.NOT_FOUND: 404,
    Code.UNKNOWN_SURROGATE: 404,
    Code.UNKNOWN_SESSION: 404,
    Code.SESSION_EXPIRED: 410,
    Code.UNKNOWN_QUERY: 404,
    Code.UNKNOWN_MODEL: 404,
    Code.UNKNOWN_POLICY: 404,
    Code.UNKNOWN_JOB: 404,
    Code.METHOD_NOT_ALLOWED: 405,
    Code.SPEC_CONFLICT: 409,
    Code.IDEMPOTENCY_CONFLICT: 409,
    Code.SEQ_CONFLICT: 409,
    Code.FOREIGN_LEASE: 403,
    Code.LEASE_EXPIRED: 409,
    Code.NOT_RESET: 409,
    Code.NO_MODEL: 409,
    Code.TOO_LARGE: 413,
    Code.UNSUPPORTED_MEDIA_TYPE: 415,
    Code.REQUEST_TIMEOUT: 408,
    Code.TOO_MANY_REQUESTS: 429,
    Code.DEADLINE_EXCEEDED: 503,
    Code.UNAVAILABLE: 503,
    Code.DAMAGED: 500,
    Code.NOT_INSTALLED: 501,
    Code.INTERNAL: 500,
}


class Problem(BaseModel):
    """Problem body (RFC 9457), which is the form of every error reply."""

    model_config = ConfigDict(extra="allow")

    type: str = "about:blank"
    title: str = Field(description="The error code in words.")
    status: int
    code: Code
    detail: str = Field(description="What was expected, and what came instead.")
    request: str | None = Field(default=None, description="Id of the request; the server's log names it too.")
    expected_seq: int | None = Field(
        default=None, description="With code seq_conflict: the number ``seq`` that the session expects next."
    )
