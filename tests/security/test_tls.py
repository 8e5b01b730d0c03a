"""TLS: who has the certificate is served, over HTTPS and WSS, and who has not refuses the server."""

from __future__ import annotations

import shutil
import ssl
import subprocess
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from support.server import ServerProcess, running_server
from surrogym_client.api import Api
from surrogym_server.errors import InvalidInput
from surrogym_server.settings import read_settings

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


def test_a_client_that_does_not_trust_it_goes_no_further(server: ServerProcess):
    with pytest.raises(httpx.ConnectError, match="CERTIFICATE_VERIFY_FAILED"):
        httpx.get(f"{server.url}/healthz", trust_env=False)


def test_the_stream_runs_over_the_same_certificate(server: ServerProcess, certificate: Path):
    """404 comes from the application: the handshake went through TLS, and there is no such session."""
    trusting = ssl.create_default_context(cafile=certificate)
    url = f"{server.url.replace('https', 'wss', 1)}/v1/sessions/none/stream"
    with pytest.raises(InvalidStatus) as refused, connect(url, ssl=trusting):
        pass
    assert refused.value.response.status_code == 404


def test_plain_http_is_not_answered(server: ServerProcess):
    with pytest.raises(httpx.TransportError):
        httpx.get(server.url.replace("https", "http", 1), trust_env=False)


@pytest.mark.parametrize("alone", ["tls_certificate", "tls_key"])
def test_a_certificate_and_its_key_come_together(certificate: Path, alone: str):
    with pytest.raises(InvalidInput, match="expected a certificate and its key"):
        read_settings({}, **{alone: certificate})
