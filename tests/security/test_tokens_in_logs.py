"""No token reaches a log: not a known one, not a mistyped one, at the level that says most and in both forms."""

from __future__ import annotations

import contextlib
from pathlib import Path

import httpx
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from support.hostile import connected, read_all
from support.server import running_server

TOKEN, MISTYPED = "the-token-of-an-admin", "a-mistyped-secret"


def requests(url: str, token: str) -> None:
    """Good and bad requests that carry a token in every place where one may be put, by mistake as well."""
    with httpx.Client(base_url=url, timeout=60) as client:
        for header in (f"Bearer {token}", f"Bearer {token} more", token, f"Basic {token}"):
            headers = {"authorization": header}
            client.get("/v1/surrogates", headers=headers)
            client.get("/v1/surrogates/none", headers=headers)
            client.post("/v1/surrogates", json={"unknown": 1}, headers=headers)
            client.post("/v1/sessions/none/step", content=b"no frame", headers=headers)
            client.get("/nowhere", headers=headers)
        client.get("/v1/surrogates", params={"token": token})
    with (
        contextlib.suppress(InvalidStatus),
        connect(
            f"{url.replace('http', 'ws', 1)}/v1/sessions/none/stream",
            additional_headers={"authorization": f"Bearer {token}"},
        ),
    ):
        pass
    with connected(url) as broken:
        broken.sendall(f"GET / HTTP/9.9\r\nauthorization: Bearer {token}\r\nbad header\r\n\r\n".encode())
        read_all(broken)


@pytest.mark.parametrize("form", ["text", "json"])
def test_no_token_appears_in_any_server_log(tmp_path: Path, form: str):
    options = ("--log-level", "debug", "--log-format", form)
    with running_server(tmp_path, *options, SURROGYM_TOKEN=TOKEN) as server:
        for token in (TOKEN, MISTYPED):
            requests(server.url, token)
    assert "/v1/surrogates/none -> 404" in server.log, "requests were logged"
    for secret in (TOKEN, MISTYPED):
        assert secret not in server.log
