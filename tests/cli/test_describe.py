"""An environment that has a name is described, and registered with one command, whichever way it is typed."""

from __future__ import annotations

import json
import os
import threading
from pathlib import Path

import pytest

pytest.importorskip("mujoco")
pytest.importorskip("imageio")


@pytest.fixture
def described(surrogym, tmp_path: Path) -> Path:
    said = surrogym("describe", "Swimmer-v5", "--steps", "60")
    assert said.code == 0, said.err
    file = tmp_path / "env.json"
    file.write_text(said.out)
    return file


def test_the_describe_command_prints_the_specification_on_stdout_and_explanations_on_stderr(surrogym) -> None:
    said = surrogym("describe", "Swimmer-v5", "--steps", "60")
    assert said.json["specification"]["environment"] == "Swimmer-v5"
    assert f"Swimmer-v5: described by {said.json['real_steps']} real steps and" in said.err
    assert "a shift of slider1, slider2 changes nothing" in said.err
    assert "to decide: success" in said.err


def test_a_described_environment_can_be_registered_by_file_or_by_name(on_server, described: Path, name) -> None:
    by_file = on_server("register", name, str(described), "--budget", "20", "--json")
    assert by_file.code == 0, by_file.err
    assert (by_file.json["name"], by_file.json["environment"]) == (name, "Swimmer-v5")
    by_option = on_server(
        "register", "Swimmer-v5", "--spec", str(described), "--name", name, "--budget", "20", "--json"
    )
    assert by_option.json["spec"] == by_file.json["spec"]
    ledger = on_server("status", name, "--json").json["ledger"]
    assert ledger["evaluation"] == json.loads(described.read_text())["real_steps"], (
        "once, though it was registered twice"
    )


def test_registering_an_environment_by_name_describes_it_and_counts_the_real_steps(on_server, name) -> None:
    said = on_server("register", name, "--env", "Swimmer-v5")
    assert said.code == 0, said.err
    assert "described by" in said.err
    steps = int(said.err.partition("described by ")[2].split()[0])
    view = on_server("status", name, "--json").json
    assert view["ledger"]["evaluation"] == steps >= 400
    again = on_server("register", name, "--env", "Swimmer-v5")
    assert (again.code, again.out) == (1, "")
    assert f"a surrogate named {name!r} exists already, and no real step was taken" in again.err
    assert "described by" not in again.err


def test_describing_an_unknown_environment_gives_a_one_sentence_error(surrogym) -> None:
    said = surrogym("describe", "nowhere")
    assert (said.code, said.out) == (1, "")
    assert said.err.startswith("error: no adapter knows the environment 'nowhere': expected a Gymnasium id")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            '{"coordinates": [',
            "env.json is not a specification: expected JSON, got a fault in line 1, column 18 (Expecting value)",
        ),
        (" \n", "env.json is not a specification: it is empty"),
        (json.dumps({"specification": {}}), "is not a specification: "),
        (json.dumps({"specification": {}, "design": {}}), "at its top level, got 'design'"),
        (json.dumps({"specification": {}, "Desing": {}}), "at its top level, got 'Desing'"),
        (json.dumps({"colour": 1}), "env.json is not a specification: colour: unknown entry; expected some of "),
    ],
)
def test_registering_a_file_without_a_specification_is_refused(surrogym, tmp_path, content: str, message: str) -> None:
    (tmp_path / "env.json").write_text(content)
    said = surrogym("register", "swimmer", "env.json", "--print-spec")
    assert said.code == 1
    assert message in said.err


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes have no names here")
def test_the_register_command_reads_a_described_environment_from_a_pipe(
    on_server, described: Path, tmp_path: Path, name
) -> None:
    """The file was read three times: ``surrogym register NAME <(surrogym describe ENV)`` ended in a traceback."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    writing = threading.Thread(target=pipe.write_bytes, args=(described.read_bytes(),), daemon=True)
    writing.start()
    said = on_server("register", name, str(pipe), "--budget", "20", "--json")
    writing.join()
    assert said.code == 0, said.err
    ledger = on_server("status", name, "--json").json["ledger"]
    assert ledger["evaluation"] == json.loads(described.read_text())["real_steps"]


def test_registering_a_too_deeply_nested_file_is_refused(surrogym, tmp_path: Path) -> None:
    (tmp_path / "deep.json").write_text(100_000 * "[")
    said = surrogym("register", "a", str(tmp_path / "deep.json"))
    assert (said.code, "deep.json is not a specification: " in said.err) == (1, True), said.err


def test_registering_with_two_names_or_two_files_is_refused(surrogym, described: Path) -> None:
    said = surrogym("register", "a", str(described), "--name", "b", "--print-spec")
    assert "expected one name, got 'a' and --name 'b'" in said.err
    said = surrogym("register", "a", str(described), "--spec", str(described), "--print-spec")
    assert "expected one specification, got the argument" in said.err
