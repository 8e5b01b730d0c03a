"""Where a command's token comes from, and what a person is told where others may see it."""

from __future__ import annotations

from pathlib import Path

import pytest

from support.scripted_server import ScriptedServer, reply, scripted_server
from surrogym_shared.wire import SurrogateList

NOTHING = reply(SurrogateList(surrogates=[]).model_dump_json())
SHOWN = "warning: --token shows the token in the list of processes; SURROGYM_TOKEN, --token-file or SURROGYM_TOKEN_FILE"


@pytest.fixture
def server():
    with scripted_server(NOTHING) as server:
        yield server


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "token"
    path.write_text("read:in-a-file\n")
    path.chmod(0o600)
    return path


def sent(server: ScriptedServer) -> str | None:
    return server.received[-1].headers.get("Authorization")


@pytest.mark.parametrize(
    ("options", "environment", "expected"),
    [
        ((), {}, None),
        (("--token-file", "token"), {}, "Bearer in-a-file"),
        ((), {"SURROGYM_TOKEN_FILE": "token"}, "Bearer in-a-file"),
        ((), {"SURROGYM_TOKEN": "own", "SURROGYM_TOKEN_FILE": "token"}, "Bearer own"),
        (("--token-file", "token"), {"SURROGYM_TOKEN": "own"}, "Bearer in-a-file"),
    ],
    ids=["none", "option", "variable", "the token before its file", "what was typed before the environment"],
)
def test_the_token_is_read_from_an_environment_variable_or_a_file(
    surrogym, server, file, monkeypatch, options, environment, expected
):
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    said = surrogym("status", "--server", server.url, *options)
    assert (said.code, said.err, sent(server)) == (0, "", expected)


def test_a_token_on_the_command_line_works_with_a_warning(surrogym, server):
    said = surrogym("status", "--server", server.url, "--token", "typed", "--json")
    assert said.json["surrogates"] == []
    assert sent(server) == "Bearer typed"
    assert said.err.startswith(SHOWN)
    assert said.err.count("\n") == 1
    assert surrogym("status", "--server", server.url, "--token", "typed", "--quiet").err == ""


def test_token_and_token_file_together_are_refused(surrogym, server, file):
    said = surrogym("status", "--server", server.url, "--token", "typed", "--token-file", "token")
    assert (said.code, server.received) == (1, [])
    assert said.err == "error: expected --token or --token-file, got both; give one of the two\n"


def test_a_token_file_readable_by_others_works_with_a_warning(surrogym, server, file):
    file.chmod(0o644)
    said = surrogym("status", "--server", server.url, "--token-file", "token")
    assert (said.code, sent(server)) == (0, "Bearer in-a-file")
    assert said.err == (
        "warning: token may be read by other users of this machine (mode 644): chmod 600 token prevents this\n"
    )
    assert surrogym("status", "--server", server.url, "--token-file", "token", "--quiet").err == ""


def test_a_missing_token_file_gives_a_one_sentence_error(surrogym, server):
    said = surrogym("status", "--server", server.url, "--token-file", "missing")
    assert (said.code, server.received) == (1, [])
    assert (
        said.err
        == "error: the token file 'missing' can't be read: No such file or directory; check its path and permissions\n"
    )


def test_the_help_warns_that_a_token_on_the_command_line_is_visible(surrogym):
    said = " ".join(surrogym("status", "--help").out.split())
    assert "A token typed here shows in the list of processes." in said
    assert "--token-file" in said
