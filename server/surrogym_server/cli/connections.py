"""Connections that bring no request, or bring it too slowly, or are too many."""

from __future__ import annotations

import asyncio
import resource

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from surrogym_server.api.problems import problem_response
from surrogym_shared.codes import Code

SPARE_FILES = 128  # for the database, pipes and whatever else is open beside connections


def connections_within(most: int) -> int:
    """Raise this process's limit of open files as far as it may; returns how many connections then fit, at most."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    return most if hard == resource.RLIM_INFINITY else max(min(most, hard - SPARE_FILES), 1)


def patient(seconds: float, most: int) -> type[HttpToolsProtocol]:
    """uvicorn's protocol, with a limit of seconds for a request to arrive whole, and of connections."""

    class Patient(HttpToolsProtocol):
        _timer: asyncio.TimerHandle | None = None

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            if len(self.connections) > most:
                self._refuse(Code.UNAVAILABLE, f"expected at most {most} connections, got one more")
            else:
                self._wait()

        def connection_lost(self, exc: Exception | None) -> None:
            self._arrived()
            super().connection_lost(exc)

        def on_message_begin(self) -> None:
            super().on_message_begin()
            self._arrived()
            self._wait()

        def on_message_complete(self) -> None:
            self._arrived()
            super().on_message_complete()

        def send_400_response(self, msg: str) -> None:
            self._refuse(Code.INVALID_REQUEST, f"expected a request of HTTP/1.1, got none: {msg}", status=400)

        def _wait(self) -> None:
            self._timer = asyncio.get_running_loop().call_later(seconds, self._late)

        def _arrived(self) -> None:
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None

        def _late(self) -> None:
            answering = self.cycle is not None and not self.cycle.response_complete
            if answering and (self.cycle.response_started or self.pipeline):
                self.transport.close()
            else:
                self._refuse(Code.REQUEST_TIMEOUT, f"expected a whole request within {seconds:g} s")

        def _refuse(self, code: Code, detail: str, status: int | None = None) -> None:
            reply = problem_response(code, detail, status=status, headers={"connection": "close"})
            lines = b"".join(name + b": " + value + b"\r\n" for name, value in reply.raw_headers)
            self.transport.write(b"HTTP/1.1 %d \r\n%s\r\n%s" % (reply.status_code, lines, bytes(reply.body)))
            self.transport.close()

    return Patient
