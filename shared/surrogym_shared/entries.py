"""Names that a model allows at a place of its input, for a message about an unknown one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel


def of_unknown(model: type[BaseModel], place: Sequence[int | str]) -> str:
    """Describe an unknown entry of an input: the allowed ones at its place, and the one that is meant perhaps.

    Args:
        model: model of the whole input.
        place: place of the entry, as pydantic gives it.
    """
    *above, name = place
    fields = list(dict.fromkeys(field for model in _models_at(model, above) for field in model.model_fields))
    close = get_close_matches(str(name), fields, n=1)
    meant = f"; did you mean {close[0]!r}?" if close else ""
    return f"unknown entry; expected some of {', '.join(fields)}{meant}" if fields else "unknown entry"


def _models_at(model: type[BaseModel], place: Sequence[int | str]) -> list[type[BaseModel]]:
    """Return the models that the input at a place may be of. A place also has the tags of unions."""
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
    """Yield the models of an annotation, within unions and collections too."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models_in(inner)


def _has_tag(model: type[BaseModel], tag: str) -> bool:
    """Whether a union names a model by ``tag``: its class, or a value of a literal field."""
    values = (
        value
        for field in model.model_fields.values()
        if get_origin(field.annotation) is Literal
        for value in get_args(field.annotation)
    )
    return model.__name__ == tag or tag in values
