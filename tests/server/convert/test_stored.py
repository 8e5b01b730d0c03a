"""A stored document that is none is damage of the database, and not a bug or a bad request."""

import pytest

from support import pendulum
from surrogym_server.convert.stored import read_stored
from surrogym_server.errors import Damaged
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import OutputFidelity


def test_a_stored_json_document_is_read_as_its_pydantic_model():
    assert read_stored(EnvironmentSpec, "a stored specification", pendulum.spec()).environment == "Pendulum-v1"


def test_the_error_for_a_damaged_document_names_document_and_field():
    broken = pendulum.spec() | {"time_limit": "long"}
    with pytest.raises(
        Damaged, match=r"^a stored specification in the database can't be read: time_limit: expected a whole number"
    ):
        read_stored(EnvironmentSpec, "a stored specification", broken)


def test_a_stored_fidelity_with_scores_that_were_removed_is_read():
    numbers = dict.fromkeys(("confidence_index", "confidence_index_paper", "tolerance", "coverage"), 0.5)
    errors = dict.fromkeys(("leave_one_out_error", "leave_one_out_within_one", "leave_one_out_within_two"))
    stored = {"name": "theta", "structure": "as is", "prequential": {"predictions": 3}, **numbers, **errors}
    assert not hasattr(read_stored(OutputFidelity, "the fidelity", stored), "prequential")
