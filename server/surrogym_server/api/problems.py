"""Conversion of each exception of the server to a reply with a problem body (RFC 9457)."""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from surrogym_server import errors
from surrogym_server.logs import REQUEST_ID
from surrogym_shared.codes import PROBLEM_MEDIA_TYPE, STATUS, Code, Problem
from surrogym_shared.faults import in_words
from surrogym_shared.frames import FrameError
from surrogym_shared.removed import remark

CODES: dict[type[errors.SurrogymError], Code] = {
    errors.InvalidInput: Code.INVALID_REQUEST,
    errors.InvalidSpec: Code.INVALID_SPEC,
    errors.TooLarge: Code.TOO_LARGE,
    errors.UnknownSurrogate: Code.UNKNOWN_SURROGATE,
    errors.UnknownQuery: Code.UNKNOWN_QUERY,
    errors.UnknownModel: Code.UNKNOWN_MODEL,
    errors.UnknownPolicy: Code.UNKNOWN_POLICY,
    errors.UnknownJob: Code.UNKNOWN_JOB,
    errors.UnknownSession: Code.UNKNOWN_SESSION,
    errors.SessionExpired: Code.SESSION_EXPIRED,
    errors.SpecConflict: Code.SPEC_CONFLICT,
    errors.IdempotencyConflict: Code.IDEMPOTENCY_CONFLICT,
    errors.SeqConflict: Code.SEQ_CONFLICT,
    errors.ForeignLease: Code.FOREIGN_LEASE,
    errors.LeaseExpired: Code.LEASE_EXPIRED,
    errors.NotReset: Code.NOT_RESET,
    errors.NoModel: Code.NO_MODEL,
    errors.Unauthenticated: Code.UNAUTHENTICATED,
    errors.Forbidden: Code.FORBIDDEN,
    errors.BeyondBudget: Code.BEYOND_BUDGET,
    errors.Overloaded: Code.TOO_MANY_REQUESTS,
    errors.DeadlineExceeded: Code.DEADLINE_EXCEEDED,
    errors.Damaged: Code.DAMAGED,
    errors.Unavailable: Code.UNAVAILABLE,
    errors.NotInstalled: Code.NOT_INSTALLED,
    errors.PluginFailed: Code.INTERNAL,
    errors.ChoiceFailed: Code.INTERNAL,
    errors.NumericalFailure: Code.INTERNAL,
}

logger = logging.getLogger(__name__)

HTTP_CODES = {
    400: Code.INVALID_REQUEST,  # FastAPI could not parse the body
    401: Code.UNAUTHENTICATED,
    403: Code.FORBIDDEN,
    404: Code.NOT_FOUND,
    408: Code.REQUEST_TIMEOUT,
    413: Code.TOO_LARGE,
    415: Code.UNSUPPORTED_MEDIA_TYPE,
    429: Code.TOO_MANY_REQUESTS,
    503: Code.UNAVAILABLE,
}

NO_FIELDS = ("body", "query", "path", "header", "float", "int", "str", "bool")
REQUEST_HEADER = "x-request-id"
RETRY_AFTER_SECONDS = "1"
SHOWN_CHARACTERS = 120


def install(app: FastAPI) -> None:
    """Make the app answer each error with a problem body, the JSON description of an error by RFC 9457."""
    for kind, answer in _ANSWERS.items():
        app.add_exception_handler(kind, answer)
    app.add_exception_handler(Exception, _unexpected)


async def answer_to(request: Request, error: Exception) -> Response:
    """Return the error reply to a request that raised ``error``. Raises an unexpected error again."""
    for kind, answer in _ANSWERS.items():
        if isinstance(error, kind):
            return await answer(request, error)
    raise error


def code_of(error: errors.SurrogymError) -> Code:
    """Return the error code of an exception: the code of its class, or else the code of its nearest base class that is
    in ``CODES``."""
    return next(CODES[cls] for cls in type(error).__mro__ if cls in CODES)


def problem_of(error: Exception) -> Problem:
    """Return the problem body (JSON by RFC 9457) of an exception; without details if the exception is unexpected."""
    match error:
        case errors.SeqConflict():
            return _problem(Code.SEQ_CONFLICT, str(error), expected_seq=error.expected)
        case errors.PluginFailed():
            logger.error("%s", error, exc_info=error)  # with a traceback, for the author of the plug-in
            return _problem(Code.INTERNAL, str(error))
        case errors.SurrogymError():
            return _problem(code_of(error), str(error))
        case FrameError():
            return _problem(Code.INVALID_REQUEST, str(error))
    return _problem(Code.INTERNAL, "the server failed on this request; its log has the details")


def response_of(problem: Problem, headers: Mapping[str, str] | None = None) -> Response:
    """Return the HTTP reply with a problem body (JSON by RFC 9457). ``headers`` are added to those of the problem's
    code."""
    return Response(
        problem.model_dump_json(exclude_none=True),
        status_code=problem.status,
        headers={**_headers(problem.code), **(headers or {})},
        media_type=PROBLEM_MEDIA_TYPE,
    )


def problem_response(
    code: Code,
    detail: str,
    *,
    status: int | None = None,
    headers: Mapping[str, str] | None = None,
    **members: Any,
) -> Response:
    """Return the HTTP reply with a problem body (JSON by RFC 9457), from an error code and a text for people.

    ``status`` defaults to that of the code; ``members`` are further fields of the problem.
    """
    return response_of(_problem(code, detail, status=status, **members), headers)


def closing_reply(code: Code, detail: str, status: int | None = None) -> bytes:
    """Return a complete HTTP reply with a problem body, as bytes, for a request that can't be passed to the app. The
    reply announces that the connection is closed after it."""
    reply = problem_response(code, detail, status=status, headers={"connection": "close"})
    lines = b"".join(name + b": " + value + b"\r\n" for name, value in reply.raw_headers)
    return b"HTTP/1.1 %d \r\n%s\r\n%s" % (reply.status_code, lines, bytes(reply.body))


def documented(*codes: Code) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI description of the error replies with these codes."""
    by_status: dict[int, list[str]] = {}
    for code in codes:
        by_status.setdefault(STATUS[code], []).append(code.value)
    return {
        status: {
            "description": f"Problem with code {' or '.join(names)}.",
            "content": {PROBLEM_MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
        }
        for status, names in by_status.items()
    }


def validation_detail(found: Sequence[Any]) -> str:
    """Describe one error of a validation in one sentence: field, expected value, actual value.

    This is the most specific error, the one with the longest path. If a value fits none of several types, this error
    belongs to the type that the value nearly fits.
    """
    telling = max(found, key=lambda error: len(error["loc"]))
    said = in_words(telling)
    came = "" if ", got " in said else f", got {shown(telling.get('input'))}"
    unknown = telling["type"] == "extra_forbidden"
    instead = remark("session option", str(telling["loc"][-1])) if unknown else ""
    return f"{_field(telling) or 'the body'}: {said}{came}{instead}"


def shown(value: Any) -> str:
    """Return a value as text for a message, cut after ``SHOWN_CHARACTERS``. The rest of a long value is not
    converted."""
    text = ""
    for piece in ["nothing"] if value is None else _pieces(value):
        text += piece
        if len(text) > SHOWN_CHARACTERS:
            return f"{text[:SHOWN_CHARACTERS]}..."
    return text


def _pieces(value: Any) -> Iterator[str]:
    """Yield the ``repr`` of a JSON value in pieces, so that a long value need not be converted completely."""
    if isinstance(value, dict):
        yield "{"
        for index, (key, entry) in enumerate(value.items()):
            yield f"{', ' if index else ''}{key!r}: "
            yield from _pieces(entry)
        yield "}"
    elif isinstance(value, list):
        yield "["
        for index, entry in enumerate(value):
            yield ", " if index else ""
            yield from _pieces(entry)
        yield "]"
    else:
        yield repr(value[: SHOWN_CHARACTERS + 1] if isinstance(value, str) else value)


def _located(found: Sequence[Any]) -> list[dict[str, str]]:
    # a list counts as empty if its entries are wrong, which other errors say
    wrong = {error["loc"][:depth] for error in found for depth in range(len(error["loc"]))}
    return [
        {
            "field": _field(error),
            "expected": in_words(error).removeprefix("expected ").removesuffix(", got nothing"),
            "got": "nothing" if error["type"] == "missing" else shown(error.get("input")),
        }
        for error in [error for error in found if error["type"] != "too_short" or error["loc"] not in wrong][:16]
    ]


def _field(error: Any) -> str:
    return ".".join(str(part) for part in error["loc"] if _is_field(part))


def _is_field(part: int | str) -> bool:
    """Whether a part of pydantic's error location is a field or an index, instead of the body or a type's name."""
    return isinstance(part, int) or (part.isidentifier() and part not in NO_FIELDS)


def _problem(code: Code, detail: str, *, status: int | None = None, **members: Any) -> Problem:
    title = code.value.replace("_", " ")
    request = REQUEST_ID.get()
    return Problem(title=title, status=status or STATUS[code], code=code, detail=detail, request=request, **members)


def _invalid(found: Sequence[Any]) -> Response:
    about_spec = "spec" in found[0]["loc"]
    code = Code.INVALID_SPEC if about_spec else Code.INVALID_REQUEST
    return problem_response(code, validation_detail(found), errors=_located(found))


async def _refused(_: Request, error: Exception) -> Response:
    return response_of(problem_of(error))


def _headers(code: Code) -> dict[str, str]:
    if code is Code.UNAUTHENTICATED:
        return {"www-authenticate": "Bearer"}
    if code in (Code.TOO_MANY_REQUESTS, Code.UNAVAILABLE, Code.DEADLINE_EXCEEDED):
        return {"retry-after": RETRY_AFTER_SECONDS}
    return {}


async def _request_invalid(_: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    return _invalid(error.errors())


async def _http_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    code = HTTP_CODES[error.status_code]
    detail = f"no route {request.url.path!r}: see /docs" if code is Code.NOT_FOUND else str(error.detail)
    return problem_response(code, detail, headers=error.headers)


async def _gone(_: Request, error: Exception) -> Response:
    """Return a reply that only the log will show, because the caller has disconnected during its request."""
    assert isinstance(error, ClientDisconnect)
    return problem_response(
        Code.REQUEST_TIMEOUT, "expected a whole request, but the connection ended before it had arrived"
    )


async def _unexpected(_: Request, error: Exception) -> Response:
    """Return the reply to an unexpected error, with status 500. Starlette logs the error."""
    assert not isinstance(error, errors.SurrogymError)
    problem = problem_of(error)
    return response_of(problem, {REQUEST_HEADER: problem.request or ""})


_ANSWERS: dict[type[Exception], Callable[[Request, Exception], Awaitable[Response]]] = {
    errors.SurrogymError: _refused,
    FrameError: _refused,
    RequestValidationError: _request_invalid,
    HTTPException: _http_error,
    ClientDisconnect: _gone,
}
