"""Reading of stored JSON documents as pydantic models of the API."""

from __future__ import annotations

from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from surrogym_server.errors import Damaged
from surrogym_shared.faults import first_fault

M = TypeVar("M", bound=BaseModel)


def read_stored(model: type[M], what: str, stored: dict[str, Any]) -> M:
    """Read a stored document as an instance of its pydantic model.

    Args:
        model: pydantic model of the document.
        what: name of the document for the error message, with an article.
        stored: the document as it is in the database.

    Raises:
        Damaged: the document does not fit the model; the message names the field.
    """
    try:
        return model.model_validate(stored)
    except ValidationError as error:
        raise Damaged(
            f"{what} in the database can't be read: {first_fault(error)}; restore a copy of the database"
        ) from error
