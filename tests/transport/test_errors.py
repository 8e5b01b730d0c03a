"""The errors of the client cover the codes of the service, and cross process boundaries."""

import pickle

import pytest

from surrogym_client import errors
from surrogym_shared.codes import STATUS, Code, Problem


def problem(code: Code) -> Problem:
    return Problem(title=code.value, status=STATUS[code], code=code, detail=f"about {code.value}", expected_seq=7)


def leaves(cls: type) -> list[type]:
    return [cls] + [leaf for child in cls.__subclasses__() for leaf in leaves(child)]


def test_every_error_code_has_its_own_client_exception():
    assert set(errors.BY_CODE) == set(Code)


def test_every_client_exception_for_a_server_refusal_has_an_error_code():
    without_code = {errors.ProblemError, errors.NotThere, errors.SessionLost, errors.Conflict, errors.Refused}
    assert set(leaves(errors.ProblemError)) - without_code == set(errors.BY_CODE.values())


@pytest.mark.parametrize("code", list(Code))
def test_a_refusal_exception_contains_its_detail_and_can_be_pickled(code: Code):
    error = errors.error_from_problem(problem(code))
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is errors.BY_CODE[code]
    assert str(again) == str(error) == f"about {code.value}"
    assert again.problem == error.problem


@pytest.mark.parametrize("cls", [errors.ServerUnreachable, errors.RequestTimeout, errors.ProtocolMismatch])
def test_client_exceptions_that_are_no_server_refusals_can_be_pickled(cls: type[Exception]):
    again = pickle.loads(pickle.dumps(cls("why")))
    assert type(again) is cls
    assert str(again) == "why"


def test_a_sequence_conflict_error_states_the_expected_number():
    error = errors.error_from_problem(problem(Code.SEQ_CONFLICT))
    assert isinstance(error, errors.SeqConflict)
    assert error.expected_seq == 7


def test_the_documented_tree_of_client_exceptions_matches_the_classes():
    drawn = [word for line in errors.__doc__.splitlines() if (word := line.strip("│├└─ ").split(" ")[0])]
    real = [cls.__name__ for cls in leaves(errors.SurrogymClientError) if cls.__module__ == errors.__name__]
    assert [word for word in drawn if word in real] == real
