"""The server under test, and a small surrogate on it that learns from a handful of noise-free samples."""

from __future__ import annotations

import time
from typing import Any, Self

import httpx

from surrogym_client.errors import NotThere, SurrogymClientError
from surrogym_client.transport.api import Api
from surrogym_sampler.diagnosis.outcomes import Mismatch, expect
from surrogym_shared import wire
from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    Design,
    EnvironmentSpec,
    Inequality,
    ObservationEntry,
    Term,
    Uniform,
)

GAIN, END, TIME_LIMIT = 0.4, 0.85, 3
LEARNING_SECONDS = 120.0
SPEC = EnvironmentSpec(
    environment="conformance",
    coordinates=(Coordinate(name="x", sampling=Uniform(low=-1, high=1)),),
    observation=(ObservationEntry(name="x", term=Term.linear(x=1)),),
    action=BoxAction(low=(-1.0,), high=(1.0,)),
    start={"x": Uniform(low=0.5, high=0.7)},
    termination=((Inequality(term=Term.linear(x=1), relation=">=", value=END),),),
    time_limit=TIME_LIMIT,
    design=Design(initial=6, budget=6),
)


class Target:
    """A server under test, and the surrogate that the test makes there. Requests whose replies are checked are sent as
    plain HTTP, so that the raw reply can be compared. All other requests go through the client ``api``."""

    def __init__(self, url: str | None, token: str | None, surrogate: str) -> None:
        self.surrogate = surrogate
        self.token = token
        self.api = Api(url, token)
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._http = httpx.Client(base_url=self.api.url, headers=headers, verify=httpx.create_ssl_context())

    def __enter__(self) -> Self:
        try:
            self.api.surrogate(self.surrogate)
        except NotThere:
            self.api.create_surrogate(self.surrogate, SPEC)
            return self
        self._close()
        raise SurrogymClientError(
            f"expected an unused surrogate name, got {self.surrogate!r}, which exists on this server: choose another "
            "name"
        )

    def __exit__(self, *_: object) -> None:
        self.api.delete_surrogate(self.surrogate)
        self._close()

    def post(self, path: str, body: object) -> httpx.Response:
        """POST ``body`` as JSON to ``path`` below /v1, and return the reply. Raises ``Mismatch`` if there is none."""
        try:
            return self._http.post(f"/v1/{path}", json=body, timeout=60)
        except httpx.TransportError as failure:
            raise Mismatch(f"{path}: expected a reply, got {failure!r}") from failure

    def post_text(self, path: str, body: str) -> httpx.Response:
        """POST a text, which may be invalid JSON, to ``path`` below /v1, and return the reply."""
        return self._http.post(f"/v1/{path}", content=body, headers={"Content-Type": "application/json"})

    def refused(self, what: str, reply: httpx.Response, status: int, code: str) -> dict[str, Any]:
        """Check that a request was refused with this status and error code, and return the problem body of the reply.

        Args:
            what: the request in words, for messages.
            reply: the server's reply.
            status: the expected HTTP status.
            code: the expected ``code`` of the problem.
        """
        expect(f"status of {what}", status, reply.status_code)
        expect(f"media type of {what}", "application/problem+json", reply.headers.get("content-type"))
        problem: dict[str, Any] = reply.json()
        expect(f"code of {what}", code, problem.get("code"))
        return problem

    def open(self, **options: object) -> str:
        """Open a session of two lanes (environments that step together), and return its id."""
        reply = self.post(f"surrogates/{self.surrogate}/sessions", {"num_envs": 2, "seed": 7, **options})
        expect("status of opening", True, reply.is_success)
        session: str = reply.json()["id"]
        return session

    def act(self, session: str, what: str, **body: object) -> dict[str, Any]:
        """Send a reset or a step, which must succeed, and return the reply's body.

        Args:
            session: the id of the session.
            what: ``reset`` or ``step``.
            body: fields of the request.
        """
        reply = self.post(f"sessions/{session}/{what}", body)
        expect(f"status of {what}", 200, reply.status_code)
        answer: dict[str, Any] = reply.json()
        return answer

    def claim(self, lease_seconds: float = wire.QUERY_LEASE_SECONDS) -> wire.StepQuery:
        """Claim one query of the surrogate under a lease of ``lease_seconds``. Raises ``Mismatch`` if there is none
        within 5 s."""
        claimed = self.api.claim(self.surrogate, "conformance", lease_seconds=lease_seconds, wait_seconds=5.0)
        expect("number of claimed queries", 1, len(claimed.queries))
        query = claimed.queries[0]
        assert isinstance(query, wire.StepQuery)
        return query

    def teach(self) -> None:
        """Answer the surrogate's queries until the server has a model of it.

        Raises:
            SurrogymClientError: there is no model within ``LEARNING_SECONDS``.
        """
        deadline = time.monotonic() + LEARNING_SECONDS
        while self.api.surrogate(self.surrogate).model_version is None:
            if time.monotonic() > deadline:
                raise SurrogymClientError(
                    f"expected a model of surrogate {self.surrogate!r} within {LEARNING_SECONDS:g} s, got none: "
                    "see the server's log"
                )
            for query in self.api.claim(self.surrogate, "conformance", max_queries=6, wait_seconds=1.0).queries:
                if isinstance(query, wire.StepQuery):
                    self.api.add_samples(self.surrogate, "conformance", [answer(query)])

    def _close(self) -> None:
        self.api.close()
        self._http.close()


def answer(query: wire.StepQuery) -> wire.NewSample:
    """Return the noise-free sample that answers a query: x' = x + 0.4 u, reward -x^2."""
    x, u = query.coordinates[0], query.action[0]
    return wire.NewSample(
        query_id=query.id,
        lease_token=query.lease_token,
        coordinates=[x],
        action=[u],
        next_coordinates=[x + GAIN * u],
        reward=-(x**2),
        terminated=x + GAIN * u >= END,
    )
