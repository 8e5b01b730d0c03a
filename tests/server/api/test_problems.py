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
def test_every_exception_class_has_an_error_code(leaf: type[errors.SurrogymError]):
    assert leaf in CODES


def test_no_two_client_exception_classes_share_an_error_code():
    codes = [code for code in CODES.values() if code is not Code.INTERNAL]
    assert len(set(codes)) == len(codes)


@pytest.mark.parametrize("code", Code)
def test_every_error_code_has_an_http_error_status(code: Code):
    assert 400 <= STATUS[code] < 600


def test_an_unlisted_exception_class_has_the_error_code_of_its_parent_class():
    class NewKind(errors.UnknownModel):
        """Not in the table."""

    assert code_of(NewKind("x")) is Code.UNKNOWN_MODEL
