"""The lines of the protocol between this client and a program, which docs/how-to/executables.md describes. All
functions are pure.

Shapes: C coordinates, F action entries.
"""

from __future__ import annotations

import json
from typing import Any, NoReturn

import numpy as np
from pydantic import ValidationError

from surrogym_sampler.original.errors import RequestRefused, StepFailed, StepRefused, UnknownEnvironment
from surrogym_sampler.original.protocol import Array, is_number
from surrogym_shared.faults import first_fault
from surrogym_shared.spec import BoxAction, EnvironmentSpec
from surrogym_shared.spec.actions import Action

PROTOCOL = 1
LONGEST_LINE = 1 << 24  # largest number of bytes of a line, without its end
SHOWN = 80  # largest number of characters of a line in an error
SHOWN_ERROR = 400  # largest number of characters of the program's own error message in an error
CHECK = "surrogym conformance --exec COMMAND checks the program"

Reply = dict[str, Any]


def encode(number: int, method: str, **fields: object) -> bytes:
    """Return the line of a request.

    Args:
        number: the request's id.
        method: the request's name, such as ``step``.
        fields: its other entries.

    Raises:
        StepFailed: a number is not finite, or the line is too long.
    """
    try:
        line = json.dumps({"id": number, "method": method, **fields}, allow_nan=False).encode()
    except ValueError as error:
        raise StepFailed(
            f"expected finite numbers in the request {method}, got {fields}: correct the code that computes them"
        ) from error
    if len(line) > LONGEST_LINE:
        raise StepFailed(
            f"expected a request of at most {LONGEST_LINE} bytes, got {method} with {len(line)}: send fewer numbers"
        )
    return line + b"\n"


def decode(line: bytes, number: int) -> Reply:
    """Return the result in the line that answers request ``number``.

    Raises:
        RequestRefused: the program answered with an error.
        StepRefused: the program answered with an error whose code is "refused".
        StepFailed: the line is not an answer to this request.
    """
    try:
        answer = json.loads(line, parse_constant=_not_finite, object_pairs_hook=_once)
    except _NotFinite as error:
        raise StepFailed(f"expected finite numbers from the program, got {error} in {short(line)}; {CHECK}") from error
    except _Twice as error:
        raise StepFailed(
            f"expected each key once from the program, got {error} twice in {short(line)}; {CHECK}"
        ) from error
    except (ValueError, RecursionError) as error:
        raise StepFailed(
            f"expected one line of JSON from the program, got {short(line)}; let it print everything else to "
            "standard error"
        ) from error
    if not isinstance(answer, dict) or type(answer.get("id")) is not int or answer["id"] != number:
        raise StepFailed(f"expected an answer with id {number} from the program, got {short(line)}; {CHECK}")
    if answer.get("error") is not None:
        said, code = one_line(str(answer["error"]), SHOWN_ERROR), one_line(str(answer.get("code", "failed")), SHOWN)
        words = f"the program answered: {said or 'an error without words'}"
        raise StepRefused(words) if code == "refused" else RequestRefused(words, code)
    if not isinstance(answer.get("result"), dict):
        raise StepFailed(f"expected 'result' or 'error' in the program's answer, got {short(line)}; {CHECK}")
    result: Reply = answer["result"]
    return result


def numbers(reply: Reply, key: str, size: int) -> Array:
    """Return the entry ``key`` of a reply, a list of ``size`` finite numbers, as an array (size,).

    Raises:
        StepFailed: the reply has no such list.
    """
    came = reply.get(key)
    if not isinstance(came, list) or len(came) != size or not all(map(is_number, came)):
        raise _wrong(f"expected {size} finite numbers for {key!r}", reply, key)
    return np.array(came, dtype=np.float64)


def number(reply: Reply, key: str) -> float:
    """Return the entry ``key`` of a reply, a finite number.

    Raises:
        StepFailed: the reply has no such number.
    """
    if not is_number(reply.get(key)):
        raise _wrong(f"expected a finite number for {key!r}", reply, key)
    return float(reply[key])


def truth(reply: Reply, key: str) -> bool:
    """Return the entry ``key`` of a reply, which is true or false.

    Raises:
        StepFailed: the reply has no such entry.
    """
    came = reply.get(key)
    if not isinstance(came, bool):
        raise _wrong(f"expected true or false for {key!r}", reply, key)
    return came


def text(reply: Reply, key: str) -> str:
    """Return the entry ``key`` of a reply, a text.

    Raises:
        StepFailed: the reply has no such text.
    """
    came = reply.get(key)
    if not isinstance(came, str):
        raise _wrong(f"expected a text for {key!r}", reply, key)
    return came


def action_entries(space: Action, action: Array) -> list[float] | list[int]:
    """Return an action (F,) as the list that a request contains: integers if the action is discrete."""
    if isinstance(space, BoxAction):
        return [float(entry) for entry in np.atleast_1d(action)]
    return [int(entry) for entry in np.atleast_1d(action)]


def specification_in(reply: Reply) -> EnvironmentSpec:
    """Return the specification in the answer to the request ``spec``.

    Raises:
        UnknownEnvironment: the program has another version of the protocol, or the specification is not valid.
    """
    version = reply.get("protocol")
    if type(version) is not int or version != PROTOCOL:
        raise UnknownEnvironment(
            f"expected protocol {PROTOCOL} from the program, got {short(version)}: update surrogym, or start the "
            f"program with protocol {PROTOCOL}"
        )
    try:
        return EnvironmentSpec.model_validate_json(json.dumps(reply.get("spec")))
    except ValidationError as error:
        raise UnknownEnvironment(
            f"expected a valid specification from the program: {first_fault(error)}; {CHECK}"
        ) from error


def _wrong(expected: str, reply: Reply, key: str) -> StepFailed:
    """Return the error for an answer whose entry ``key`` can't be used; its message begins with ``expected``."""
    return StepFailed(f"{expected} in the program's answer, got {_got(reply, key)}; {CHECK}")


class _Twice(ValueError):
    """An object of a program's answer has one key twice, so that its value is ambiguous."""


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise _Twice(repr(one_line(key, SHOWN)))
        found[key] = value
    return found


class _NotFinite(ValueError):
    """A program's answer contains NaN or an infinity, which is not JSON."""


def _not_finite(constant: str) -> NoReturn:
    raise _NotFinite(constant)


def _got(reply: Reply, key: str) -> str:
    return short(reply[key]) if key in reply else "nothing"


def short(value: object) -> str:
    """Return a line or another value in the shortened form in which an error shows it."""
    if not isinstance(value, bytes):
        return one_line(repr(value), SHOWN)
    return one_line(value.decode(errors="replace"), SHOWN) or ("no printable character" if value else "an empty line")


def one_line(text: str, most: int) -> str:
    """Return the printable characters of a text in one line, shortened to at most ``most`` characters."""
    printable = "".join(c if c.isprintable() else " " for c in text[: 2 * most])
    line = " ".join(printable.split())
    return line if len(line) <= most and len(text) <= 2 * most else f"{line[:most]}…"
