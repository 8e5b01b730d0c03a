"""Reports of drift reach the address that the operator set, and neither a slow nor a broken receiver delays them."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from support.server import running_server
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum
from surrogym_server.features.policies import routes, webhook
from surrogym_server.features.policies.webhook import WAITING, Webhook
from surrogym_shared import wire
from surrogym_shared.network import Network


class Receiver(ThreadingHTTPServer):
    """Answers posts with the statuses in ``answers``, one after the other, then with 200, and keeps them."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.answers: list[int] = []
        self.received: list[Any] = []
        self.arrived = threading.Semaphore(0)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/alarms?key=secret"


class Handler(BaseHTTPRequestHandler):
    server: Receiver

    def do_POST(self) -> None:
        content = self.rfile.read(int(self.headers["content-length"]))
        self.server.received.append((self.path, json.loads(content)))
        self.send_response(self.server.answers.pop(0) if self.server.answers else 200)
        self.send_header("content-length", "0")
        self.end_headers()
        self.server.arrived.release()

    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    with Receiver() as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def test_a_report_of_drift_is_posted_once_to_the_address_of_the_operator(receiver: Receiver, tmp_path: Path):
    spec = pendulum()
    vector = np.zeros(Network.size(spec, 4))
    Network.of(spec, np.zeros(3), np.ones(3), 4, vector).save(tmp_path / "policy.zip")
    with (
        running_server(tmp_path, "--log-level", "debug", SURROGYM_DRIFT_WEBHOOK=receiver.url) as server,
        Api(server.url) as api,
        httpx.Client(base_url=server.url) as client,
    ):
        api.create_surrogate("plant", spec)
        card = wire.PushedCard(algorithm="CMAES", spec=spec)
        api.policies.push("plant", card, [], "zip", (tmp_path / "policy.zip").read_bytes())
        for _ in range(2):
            assert client.post("/v1/surrogates/plant/policies/1/drifts", json=routes.DRIFT_EXAMPLE).status_code == 201
        assert receiver.arrived.acquire(timeout=60)
        time.sleep(0.2)
        assert "key=secret" not in server.log
    drift = {name: value for name, value in routes.DRIFT_EXAMPLE.items() if name != "idempotency_key"}
    message = {"event": "drift", "surrogate": "plant", "policy_version": 1, **drift}
    assert receiver.received == [("/alarms?key=secret", message)]


def test_a_failed_delivery_is_tried_again_and_a_lost_one_is_logged_without_the_path(
    receiver: Receiver, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    monkeypatch.setattr(webhook, "PAUSES", (0.01, 0.01))
    receiver.answers = [503, 302, 200, 500, 500, 500]
    hook = Webhook(receiver.url)
    with caplog.at_level(logging.ERROR):
        hook.post({"event": "first"})
        hook.post({"event": "lost"})
        hook.post({"event": "last"})
        for _ in range(7):
            assert receiver.arrived.acquire(timeout=60)
    assert [message["event"] for _, message in receiver.received] == ["first"] * 3 + ["lost"] * 3 + ["last"]
    (line,) = [record.getMessage() for record in caplog.records]
    assert "127.0.0.1" in line
    assert "status 500" in line
    assert "secret" not in line


def test_an_answer_without_end_does_not_delay_the_next_message(receiver: Receiver, monkeypatch: pytest.MonkeyPatch):
    """The server read all of it into its memory."""

    def endless(handler: Handler) -> None:
        content = handler.rfile.read(int(handler.headers["content-length"]))
        receiver.received.append(json.loads(content)["event"])
        receiver.arrived.release()
        handler.send_response(200)
        handler.end_headers()
        with suppress(ConnectionError):
            while True:
                handler.wfile.write(bytes(4096))
                time.sleep(0.01)

    monkeypatch.setattr(Handler, "do_POST", endless)
    hook = Webhook(receiver.url)
    for event in ("first", "second"):
        hook.post({"event": event})
        assert receiver.arrived.acquire(timeout=10)
    assert receiver.received == ["first", "second"]


def test_messages_beyond_the_limit_are_dropped_and_logged(caplog: pytest.LogCaptureFixture, monkeypatch):
    monkeypatch.setattr(Webhook, "_deliver_all", lambda _: None)
    hook = Webhook("http://127.0.0.1:9/alarms")
    with caplog.at_level(logging.ERROR):
        for _ in range(WAITING + 1):
            hook.post({})
    assert len(caplog.records) == 1
