"""The error table is total, and every code has a status."""

from __future__ import annotations

import pytest

from surrogym_server import errors
from surrogym_server.api.problems import CODES, code_of
from surrogym_shared.codes import STATUS, Code


def leaves(cls: type[errors.SurrogymError]) -> list[type[errors.SurrogymError]]:
    below = cls.__subclasses__()
    return [leaf for sub in below for leaf in leaves(sub)] if below else [cls]


@pytest.mark.parametrize("leaf", leaves(errors.SurrogymError))
def test_every_error_has_a_code_of_its_own(leaf: type[errors.SurrogymError]):
    assert leaf in CODES


def test_no_two_kinds_of_client_error_share_a_code():
    codes = [code for code in CODES.values() if code is not Code.INTERNAL]
    assert len(set(codes)) == len(codes)


@pytest.mark.parametrize("code", Code)
def test_every_code_has_a_status(code: Code):
    assert 400 <= STATUS[code] < 600


def test_a_class_below_the_table_has_the_code_above_it():
    class NewKind(errors.UnknownModel):
        """Not in the table."""

    assert code_of(NewKind("x")) is Code.UNKNOWN_MODEL
