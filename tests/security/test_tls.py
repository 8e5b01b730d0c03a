"""TLS: who has the certificate is served, over HTTPS and WSS, and who has not refuses the server."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from support.server import ServerProcess, running_server
from support.teaching import teach
from surrogym_client.transport import Api
from surrogym_client.transport.stream import Stream
from surrogym_sampler.original.classic import pendulum
from surrogym_server.errors import InvalidInput
from surrogym_server.settings import read_settings
from surrogym_shared import frames

pytestmark = pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the certificate")


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A certificate of our own for 127.0.0.1, its key beside it as ``key.pem``."""
    folder = tmp_path_factory.mktemp("tls")
    command = "openssl req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=surrogym -addext subjectAltName=IP:127.0.0.1"
    subprocess.run([*command.split(), "-keyout", "key.pem", "-out", "cert.pem"], cwd=folder, check=True)
    return folder / "cert.pem"


@pytest.fixture(scope="module")
def server(certificate: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    options = ("--tls-certificate", str(certificate), "--tls-key", str(certificate.with_name("key.pem")))
    with running_server(tmp_path_factory.mktemp("server"), *options) as running:
        yield running


def test_a_client_that_trusts_the_certificate_is_served(
    server: ServerProcess, certificate: Path, monkeypatch: pytest.MonkeyPatch
):
    assert server.url.startswith("https://")
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
    with Api(server.url) as api:
        assert api.surrogates() == []


def test_a_client_that_does_not_trust_the_certificate_refuses_the_server(server: ServerProcess):
    with pytest.raises(httpx.ConnectError, match="CERTIFICATE_VERIFY_FAILED"):
        httpx.get(f"{server.url}/healthz", trust_env=False)


def test_steps_over_a_tls_stream_use_the_same_certificate(
    server: ServerProcess, certificate: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
    with Api(server.url) as api:
        teach(api, "pendulum", pendulum(), queries=12)
    opened = httpx.post(f"{server.url}/v1/surrogates/pendulum/sessions", json={"seed": 0}, timeout=60)
    # The product's client, not websockets' with its thread: before Python 3.13 two threads must not share a TLS socket.
    stream = Stream(f"{server.url}/v1/sessions/{opened.json()['id']}/stream", None, connect_seconds=60)
    requests = [frames.reset_request(1, None, None), frames.step_request(2, np.array([[0.5]]), None, False)]
    for request, reply in zip(requests, (frames.ResetReply, frames.StepReply), strict=True):
        assert isinstance(frames.read_reply(stream.exchange(frames.encode(request), seconds=60)), reply)
    stream.close()


def test_a_tls_server_does_not_answer_plain_http(server: ServerProcess):
    with pytest.raises(httpx.TransportError):
        httpx.get(server.url.replace("https", "http", 1), trust_env=False)


@pytest.mark.parametrize("alone", ["tls_certificate", "tls_key"])
def test_a_tls_certificate_without_key_or_key_without_certificate_is_refused(certificate: Path, alone: str):
    with pytest.raises(InvalidInput, match="expected a certificate and its private key"):
        read_settings({}, **{alone: certificate})
