"""Describe the errors of a pydantic validation in words for a person who does not know pydantic."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from surrogym_shared.checks import SHOWN
from surrogym_shared.patterns import IN_WORDS

REWORDED = (  # regular expressions of pydantic's messages, and their replacements
    (r"^Value error, ", ""),
    (r"^Field required$", "expected a value, got nothing"),
    (r"^Extra inputs are not permitted$", "expected no entry of this name"),
    (r"^(Input|String|Bytes|URL) should (be |have )?", "expected "),
    (r"^expected (greater|less) ", r"expected a number \1 "),
    (r"a valid (dictionary|object)( or .*)?$", "an object with named entries"),
    (r"a valid (list|tuple|array)\b", "a list"),
    (r"a valid boolean\b", "true or false"),
    (r"a valid integer\b", "a whole number"),
    (r"a valid string\b", "a text"),
    (r"a valid ", "a "),
)


def first_fault(error: ValidationError, *, got: bool = False, of: type[BaseModel] | None = None) -> str:
    """Describe the first fault of a validation error: path of the wrong entry, such as ``action.low.0``, and fault.

    Args:
        error: error of a pydantic validation.
        got: whether the description ends with the wrong value.
        of: model of the input. With it, an unknown entry is described together with the allowed ones. It is also
            described before a missing entry, because it may be the missing one with a wrong name.
    """
    faults = error.errors()
    unknown = next((fault for fault in faults if fault["type"] == "extra_forbidden"), None)
    first = unknown if of is not None and unknown is not None and faults[0]["type"] == "missing" else faults[0]
    where = ".".join(str(part) for part in first["loc"])
    unknown_entry = first["type"] == "extra_forbidden"
    said = of_unknown(of, first["loc"]) if of is not None and unknown_entry else in_words(first)
    came = f", got {repr(first['input'])[:SHOWN]}" if got and where and ", got " not in said else ""
    return f"{where}{': ' if where else ''}{said}{came}"


def in_words(fault: ErrorDetails) -> str:
    """Describe what a validation expected, in words for people who don't know Python."""
    context = fault.get("ctx", {})
    match fault["type"]:
        case "too_short":
            return f"expected {context['min_length']} or more entries, got {context['actual_length']}"
        case "too_long" if context["actual_length"] is not None:
            return f"expected at most {context['max_length']} entries, got {context['actual_length']}"
        case "string_pattern_mismatch":
            pattern = context["pattern"]
            return f"expected {IN_WORDS.get(pattern, f'text that matches the regular expression {pattern}')}"
        case "union_tag_invalid":
            return f"expected {context['discriminator']} to be one of {context['expected_tags']}"
        case "union_tag_not_found":
            return f"expected an entry {context['discriminator']}, which says of which kind it is"
    said = fault["msg"]
    for pydantic, ours in REWORDED:
        said = re.sub(pydantic, ours, said)
    return said


def of_unknown(model: type[BaseModel], place: Sequence[int | str]) -> str:
    """Describe an unknown entry of an input: list the allowed names, and suggest the most similar one.

    Args:
        model: model of the whole input.
        place: path of the entry, in the form of pydantic's ``loc``.
    """
    *above, name = place
    fields = list(dict.fromkeys(field for model in _models_at(model, above) for field in model.model_fields))
    close = get_close_matches(str(name), fields, n=1)
    meant = f"; did you mean {close[0]!r}?" if close else ""
    return f"unknown entry; expected some of {', '.join(fields)}{meant}" if fields else "unknown entry"


def _models_at(model: type[BaseModel], place: Sequence[int | str]) -> list[type[BaseModel]]:
    """Return the models that may apply at a path into the input. A path has names of fields, indices and union tags."""
    models = [model]
    inner: list[Any] = [model]
    for part in place:
        fields = [one.model_fields[part].annotation for one in models if part in one.model_fields]
        if fields:
            inner = fields
        models = [one for annotation in inner for one in _models_in(annotation)]
        if not fields and (tagged := [one for one in models if _has_tag(one, str(part))]):
            models = tagged
        inner = list(models)
    return models


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the pydantic models in a type annotation, also those within unions and collections."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models_in(inner)


def _has_tag(model: type[BaseModel], tag: str) -> bool:
    """Whether ``tag`` selects this model in a union: it is the class name, or a value of one of its literal fields."""
    values = (
        value
        for field in model.model_fields.values()
        if get_origin(field.annotation) is Literal
        for value in get_args(field.annotation)
    )
    return model.__name__ == tag or tag in values
