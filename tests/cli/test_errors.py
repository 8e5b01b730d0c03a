"""What can't be done is told in one sentence, with a non-zero exit, never as a traceback."""

from unittest.mock import Mock

import pytest

from support.scripted_server import problem, reply, scripted_server
from surrogym.cli.commands.evaluate import enter_steps
from surrogym_client.errors import ServerUnreachable
from surrogym_client.transport import Api
from surrogym_shared.archives import stored
from surrogym_shared.codes import Code

NOBODY = ("--server", "http://127.0.0.1:9")


@pytest.fixture
def quickly(monkeypatch):
    monkeypatch.setattr("surrogym.cli.options.QUICK", 0.0)


def refused(said, code=1):
    """One line on standard error, nothing on standard output."""
    assert said.code == code
    assert said.out == ""
    assert said.err.startswith("error: ")
    assert said.err.count("\n") == 1
    return said.err


@pytest.mark.parametrize(
    "arguments",
    [
        ("register", "Pendulum-v1"),
        ("sample", "pendulum"),
        ("train", "pendulum"),
        ("status",),
        ("improve", "pendulum"),
        ("export", "pendulum", "--out", "samples.csv"),
        ("delete", "pendulum", "--yes"),
    ],
)
def test_the_error_for_an_unreachable_server_recommends_serve(surrogym, quickly, arguments):
    said = refused(surrogym(*arguments, *NOBODY))
    assert "no Surrogym server answers at http://127.0.0.1:9" in said
    assert said.count("start one with surrogym serve") == 1


def test_the_error_of_a_training_says_what_was_saved(surrogym, monkeypatch):
    """Notes of exceptions show in tracebacks alone."""
    error = ServerUnreachable("the server is gone")
    error.add_note("the policy so far is in policy.zip")
    monkeypatch.setattr("surrogym.cli.commands.train._trainable", Mock(side_effect=error))
    assert refused(surrogym("train", "pendulum")).endswith("; the policy so far is in policy.zip\n")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("optimise", "pendulum"), "No such command: optimise; 'optimise' was removed: use surrogym train"),
        (("reproduce",), "No such command: reproduce; 'reproduce' was removed: use python -m surrogym_lab"),
        (("demo", "--arm", "paper"), "No such option: --arm; '--arm' was removed: use python -m surrogym_lab demo"),
    ],
)
def test_the_error_for_a_removed_command_or_option_names_its_replacement(surrogym, arguments, message):
    said = surrogym(*arguments)
    assert (said.code, said.out) == (2, "")
    assert f"Error: {message}" in said.err


def test_an_invalid_server_address_is_refused(surrogym):
    assert "expected a server address" in refused(surrogym("status", "--server", "pendulum"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("register", "Nowhere-v1"), "Nowhere-v1 can't be made: "),
        (("register", "nothing.at_all:here"), "No module named 'nothing'"),
        (("register", "CartPole-v1", "--bins", "3"), "bins need a continuous action, got a discrete one"),
        (("register", "Pendulum-v1", "--budget", "5", "--initial", "9"), "initial 9 exceeds the budget 5"),
        (("register", "tank.Tank"), "did you mean tank:Tank?"),
        (("register",), "expected an environment or --spec FILE, got neither"),
        (("register", "--spec", "missing.json"), "missing.json: No such file or directory"),
        (("register", "--spec", "broken.json"), "broken.json is not a specification: "),
        (("register", "--spec", "crossed.json"), "uniform range crosses: expected low < high, got [1.0, -1.0]"),
        (("train", "pendulum", "--start-from", "missing.zip"), "missing.zip: no such policy file"),
        (
            ("train", "pendulum", "--spread", "0"),
            "--spread works with variant probabilistic alone: give --variant probabilistic",
        ),
        (("change", "pendulum", "--tolerance", "theta=small"), "expected output=number, such as theta=0.01"),
        (("evaluate", "missing.zip", "--env", "Pendulum-v1"), "missing.zip: no such policy file"),
        (("evaluate", "junk.zip", "--env", "Pendulum-v1"), "error: junk.zip is not a policy: expected a ZIP file"),
        (("evaluate", "junk.csv"), "error: junk.csv is not a policy: expected a ZIP file"),
        (("train", "pendulum", "--start-from", "junk.csv"), "error: junk.csv is not a policy: expected a ZIP file"),
        (("evaluate", "empty.zip", "--env", "Pendulum-v1", "--quiet"), "empty.zip is not a policy of PPO"),
        (("evaluate", "empty.zip"), "expected --env with the original environment, got none"),
        (("evaluate", "empty.zip", "--env", "Nowhere-v1"), "Nowhere-v1 can't be made: "),
        (
            ("evaluate", "empty.zip", "--env", "Pendulum-v1", "--algorithm", "Magic"),
            "Stable-Baselines3 has no algorithm 'Magic'",
        ),
        (("import", "missing.surrogate"), "missing.surrogate: No such file or directory"),
        (
            ("import", "junk.zip"),
            "expected a surrogate's file, or a log with a heading and rows, got neither in junk.zip",
        ),
        (("demo", "pendulum", "--out", "."), "expected an empty run folder, got ., which holds files already"),
        (("demo", "pendulum", "--json", "no/such/m.json"), "expected an existing folder for --json, got no/such"),
        (
            ("export", "pendulum", "--out", "samples.txt"),
            "expected a file ending in .surrogate, .csv, .npz, .safetensors or .json, got '.txt'",
        ),
    ],
)
def test_missing_or_invalid_files_give_a_one_sentence_error(surrogym, tmp_path, arguments, message):
    (tmp_path / "broken.json").write_text("{")
    (tmp_path / "crossed.json").write_text(
        '{"coordinates": [{"name": "x", "sampling": {"kind": "uniform", "low": 1, "high": -1}}]}'
    )
    for junk in ("junk.zip", "junk.csv"):
        (tmp_path / junk).write_bytes(b"this is no zip file")
    (tmp_path / "junk.json").write_text('{"state": {"c": "concentration"}}')  # a mapping of the log, and no card
    (tmp_path / "empty.zip").write_bytes(stored({}))
    assert message in refused(surrogym(*arguments))


@pytest.mark.parametrize(
    "command", ["evaluate", "audit", "export-policy", "policy push", "train pendulum --start-from"]
)
@pytest.mark.parametrize("policy", ["pendulum@1", "my.tank@production", "tank@latest"])
def test_a_reference_to_a_stored_policy_in_place_of_a_file_names_the_download(surrogym, command, policy):
    out = ("--out", "policy.onnx") if command == "export-policy" else ()
    said = refused(surrogym(*command.split(), policy, *out))
    get = f"surrogym policy get {policy} --out policy.zip"
    assert said == f"error: {policy}: no such policy file; to download it from the server: {get}\n"


def test_a_missing_file_that_is_no_reference_names_no_download(surrogym):
    for policy in ("a/b@1", "tank@", "@1", "tank@1.zip", "tank@A"):
        assert refused(surrogym("evaluate", policy)) == f"error: {policy}: no such policy file\n"


@pytest.mark.parametrize(
    "arguments",
    [("status", "--nonsense"), ("unknown",), ("sample",), ("train", "x", "--steps", "many"), ("demo", "chess")],
)
def test_wrong_command_line_usage_exits_with_code_2_and_without_traceback(surrogym, arguments):
    said = surrogym(*arguments)
    assert said.code == 2
    assert "Traceback" not in said.err
    assert said.err


@pytest.mark.parametrize("command", ["sample", "train", "status", "improve", "report"])
def test_the_error_for_an_unknown_surrogate_recommends_register_and_status(on_server, command):
    said = refused(on_server(command, "nobody"))
    assert "nobody" in said
    assert "; register it first by surrogym register ENVIRONMENT --name NAME; " in said
    assert said.endswith("; surrogym status lists the existing ones\n")


def test_an_evaluation_reported_to_an_unknown_surrogate_recommends_register(server_process, capsys):
    enter_steps("nobody", server_process.url, None, 5, 1, "1 episode", quiet=False)
    said = capsys.readouterr().err
    assert said.startswith("not entered into the ledger of 'nobody': ")
    assert "register it first by surrogym register ENVIRONMENT --name NAME" in said


@pytest.mark.parametrize(
    ("answer", "way_out"),
    [
        (problem(Code.UNAUTHENTICATED), "; give a token of this server by SURROGYM_TOKEN or --token-file"),
        (problem(Code.FORBIDDEN), "; surrogym doctor shows what this token may do"),
        (reply("<html>"), "; surrogym doctor shows more"),
    ],
    ids=["no token", "a token of another role", "another program"],
)
def test_errors_from_the_server_end_with_the_recommended_remedy(surrogym, answer, way_out):
    with scripted_server(answer) as server:
        assert refused(surrogym("status", "--server", server.url)).endswith(f"{way_out}\n")


@pytest.mark.parametrize(
    "arguments",
    [
        ("train", "pendulum", "--penalty", "nan"),
        ("sample", "pendulum", "--wait", "inf"),
        ("change", "pendulum", "--target", "nan"),
        ("evaluate", "policy.zip", "--perturb", "nan"),
    ],
)
def test_options_with_nan_or_infinite_values_are_refused(surrogym, arguments):
    """NaN passes every range, because each comparison with it is false."""
    said = surrogym(*arguments)
    assert said.code == 2
    assert f"Invalid value for '{arguments[2]}': expected a finite number, got {arguments[3]}" in said.err


def test_an_environment_that_fails_to_close_can_be_registered(surrogym, server_process, monkeypatch, name):
    """The command ended in a traceback, and nothing was registered."""

    def close(_):
        raise ValueError("the port is busy")

    monkeypatch.setattr("support.moody.Line.close", close)
    said = surrogym("register", "support.moody:Line", "--name", name, "--server", server_process.url)
    assert said.code == 0, said.err
    assert "support.moody:Line could not be closed: ValueError: the port is busy" in said.err
    with Api(server_process.url) as api:
        assert api.surrogate(name).phase
        api.delete_surrogate(name)
