"""The command, run in this process as a person would run it."""

from __future__ import annotations

import uuid

import pytest

from support.saying import speaker
from surrogym.cli import main


@pytest.fixture
def surrogym(capsys, monkeypatch, tmp_path):
    """``surrogym("status", "--json")`` gives exit code, output and errors."""
    monkeypatch.setattr("surrogym_client.surrogates.waiting.STARTING_SECONDS", 0.1)
    return speaker(main, capsys, monkeypatch, tmp_path)


@pytest.fixture
def on_server(surrogym, server_process):
    """The same, against a live server."""
    return lambda *arguments: surrogym(*arguments, "--server", server_process.url)


@pytest.fixture
def name():
    return f"cli-{uuid.uuid4().hex[:8]}"
