"""Shell completion: it installs itself, and completes the names of a server's surrogates, soon or not at all."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

from surrogym.cli.options import QUICK


def run(*arguments: str, **environment: str) -> str:
    kept = {name: value for name, value in os.environ.items() if not name.startswith("SURROGYM_")}
    command = [sys.executable, "-m", "surrogym", *arguments]
    return subprocess.run(
        command, env=kept | environment, capture_output=True, text=True, check=False, timeout=60
    ).stdout


def complete(line: str, url: str) -> list[str]:
    """What bash would offer behind a line."""
    words = line.split(" ")
    given = {"_SURROGYM_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)}
    return run(**given, SURROGYM_URL=url).split()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_command_line_can_install_its_shell_completion(tmp_path, shell):
    quiet = {"HOME": str(tmp_path), "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    assert f"{shell} completion installed" in run("--install-completion", shell, **quiet)
    written = [path.read_text() for path in tmp_path.rglob("*") if path.is_file()]
    assert any("_SURROGYM_COMPLETE=complete_" in text for text in written)


def test_shell_completion_completes_commands_and_surrogate_names(pendulum_server):
    assert "status" in complete("surrogym sta", pendulum_server.url)
    assert complete("surrogym train pend", pendulum_server.url) == ["pendulum"]
    assert complete("surrogym train xyz", pendulum_server.url) == []


def test_shell_completion_without_a_server_is_silent():
    started = time.monotonic()
    assert complete("surrogym export pend", "http://127.0.0.1:9") == []
    assert time.monotonic() - started < QUICK + 10  # the start of Python on a busy machine included
