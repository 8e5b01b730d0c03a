"""Every command explains itself, at once."""

import subprocess
import sys

import pytest

from support.commands import command_line
from surrogym.cli import ADVANCED, COMMANDS, GROUPS


@pytest.mark.parametrize("command", [*COMMANDS, "serve"])
def test_the_help_of_every_command_contains_an_example(surrogym, command):
    said = surrogym(*command.split(), "--help")
    assert said.code == 0
    assert f"Example: surrogym {command} " in said.out


def test_the_main_help_lists_all_commands(surrogym):
    said = surrogym("--help")
    assert said.code == 0
    assert all(f"  {command} " in said.out for command in (*COMMANDS, "serve"))
    listed = said.out.partition("Start:")[2]
    assert "..." not in listed  # each says what it does in a line that is whole
    assert [line for line in listed.splitlines() if line.endswith(":")] == ["Loop:", "After:", "Operate:"]


def test_every_command_listed_in_a_help_group_exists():
    assert {name for names in GROUPS.values() for name in names} <= set(command_line().commands)


@pytest.mark.parametrize("command", ADVANCED)
def test_expert_options_are_listed_last_under_their_own_heading(surrogym, command):
    usual, _, advanced = surrogym(command, "--help").out.partition("\nAdvanced:\n")
    for option in ADVANCED[command]:
        assert f"\n  {option} " in f"\n{advanced}"
        assert f"\n  {option} " not in usual.partition("\nOptions:\n")[2]


def test_the_version_option_prints_the_version(surrogym):
    assert surrogym("--version").out.startswith("surrogym 0.")


def test_printing_help_imports_no_heavy_package():
    script = (
        "import sys, surrogym.cli as cli; cli.build();"
        "print([m for m in ('torch', 'httpx', 'fastapi', 'stable_baselines3') if m in sys.modules])"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == "[]"


def test_the_error_for_a_missing_optional_dependency_names_it():
    script = "import sys; sys.modules['uvicorn'] = None; import surrogym.cli as cli; cli.main(['serve'])"
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert ended.stderr == ("error: this needs uvicorn, which is not installed: pip install 'surrogym[server]'\n")
