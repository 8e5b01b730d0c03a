"""Reading of stored documents with the wire's models."""

from __future__ import annotations

from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from surrogym_server.errors import Damaged
from surrogym_shared.faults import first_fault

M = TypeVar("M", bound=BaseModel)


def read_stored(model: type[M], what: str, stored: dict[str, Any]) -> M:
    """Read a document as an instance of its model.

    Args:
        model: the model that it was written from.
        what: its name in the error, with an article.
        stored: the document in the database.

    Raises:
        Damaged: the document does not fit the model; names the field.
    """
    try:
        return model.model_validate(stored)
    except ValidationError as error:
        raise Damaged(f"{what} can't be read: {first_fault(error)}") from error
