"""A command line, run in this process as a person would run it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

Main = Callable[[Sequence[str]], None]


@dataclass(frozen=True)
class Said:
    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        return json.loads(self.out)


def speaker(
    main: Main, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, folder: Path
) -> Callable[..., Said]:
    """``run("status", "--json")`` gives exit code, output and errors of a command in the folder, without settings of
    this machine."""
    monkeypatch.chdir(folder)
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
