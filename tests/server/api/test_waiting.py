"""Requests that wait: a limit for each token, with a refusal that says so."""

from __future__ import annotations

from contextlib import ExitStack

import pytest
from fastapi import Request

from surrogym_server.api.door import Waiting
from surrogym_server.errors import Overloaded


def of(token: str) -> Request:
    return Request({"type": "http", "headers": [(b"authorization", f"Bearer {token}".encode())]})


def test_each_token_has_its_own_limit_of_concurrent_waiting_requests():
    waiting = Waiting("streams", most=2)
    with ExitStack() as places:
        for _ in range(2):
            waiting.require_room(of("one"))
            places.enter_context(waiting.count(of("one")))
        with pytest.raises(Overloaded, match="at most 2 streams with one token"):
            waiting.require_room(of("one"))
        waiting.require_room(of("another"))
    waiting.require_room(of("one"))
