"""Every command explains itself, at once."""

import subprocess
import sys

import pytest

from support.commands import command_line
from surrogym_client.cli import COMMANDS

STUDIES = [f"reproduce {name}" for name in command_line().commands["reproduce"].commands]


@pytest.mark.parametrize("command", [*COMMANDS, *STUDIES, "serve"])
def test_help_has_an_example(surrogym, command):
    said = surrogym(*command.split(), "--help")
    assert said.code == 0
    assert f"Example: surrogym {command} " in said.out


def test_the_command_alone_lists_all_commands(surrogym):
    said = surrogym("--help")
    assert said.code == 0
    assert all(f"  {command} " in said.out for command in (*COMMANDS, "serve", "optimise"))
    assert "..." not in said.out.partition("Commands:")[2]  # each says what it does in a line that is whole


def test_version(surrogym):
    assert surrogym("--version").out.startswith("surrogym 0.")


def test_help_imports_nothing_heavy():
    script = (
        "import sys, surrogym_client.cli as cli; cli.build();"
        "print([m for m in ('torch', 'httpx', 'fastapi', 'stable_baselines3') if m in sys.modules])"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == "[]"


def test_a_missing_extra_is_named():
    script = "import sys; sys.modules['uvicorn'] = None; import surrogym_client.cli as cli; cli.main(['serve'])"
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert ended.stderr == ("error: this needs uvicorn, which is not installed: pip install 'surrogym[server]'\n")
