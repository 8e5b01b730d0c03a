"""The command, run in this process as a person would run it."""

from __future__ import annotations

import json
import uuid
from dataclasses import dataclass
from typing import Any

import pytest

from surrogym_client.cli import main


@dataclass(frozen=True)
class Said:
    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        return json.loads(self.out)


@pytest.fixture
def surrogym(capsys, monkeypatch, tmp_path):
    """``surrogym("status", "--json")`` gives exit code, output and errors."""
    monkeypatch.chdir(tmp_path)
    for name in ("SURROGYM_URL", "SURROGYM_TOKEN", "SURROGYM_TOKEN_FILE"):
        monkeypatch.delenv(name, raising=False)

    def run(*arguments: str) -> Said:
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        captured = capsys.readouterr()
        code = ended.value.code
        return Said(int(code) if code is not None else 0, captured.out, captured.err)

    return run


@pytest.fixture
def on_server(surrogym, server_process):
    """The same, against a live server."""
    return lambda *arguments: surrogym(*arguments, "--server", server_process.url)


@pytest.fixture
def name():
    return f"cli-{uuid.uuid4().hex[:8]}"
