"""``surrogym deploy`` writes a controller and runs it beside its policy."""

from __future__ import annotations

import shutil
import uuid
from pathlib import Path

import pytest

from support.compilers import NEEDS_C
from support.controllers import network
from support.saying import speaker
from surrogym.cli import main
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_trainer.policies.card import read_card, write_card
from surrogym_trainer.policies.controller_check import StoredCheck, write_check
from surrogym_trainer.policies.pushing import push


@pytest.fixture
def surrogym(capsys, monkeypatch, tmp_path):
    return speaker(main, capsys, monkeypatch, tmp_path)


def policy_for(folder: Path, spec, surrogate: str | None) -> Path:
    path = network(folder, spec, (32,))
    write_card(path, read_card(path).model_copy(update={"surrogate": surrogate}))
    return path


def test_a_stored_policy_is_deployed_by_name_and_checked_in_the_virtual_environment(
    surrogym, pendulum_server, tmp_path
):
    with Api(pendulum_server.url) as api:
        path = policy_for(tmp_path, api.surrogate("pendulum").spec, "pendulum")
        version = push(api, path).policy.version
    check = ["--check", "--episodes", "2"] if shutil.which("cc") else []
    deploy = ["deploy", f"pendulum@{version}", "--target", "c", "--out", "c", *check]
    said = surrogym(*deploy, "--server", pendulum_server.url, "--json")
    assert said.code == 0, said.err
    unchecked = surrogym(*deploy[:4], "--out", "unchecked", "--server", pendulum_server.url)
    assert f"surrogym policy get pendulum@{version}" in unchecked.out
    names = [Path(file).name for file in said.json["files"]]
    assert names[:3] == ["pendulum_controller.c", "pendulum_controller.h", "pendulum_main.c"]
    if check:
        assert names[3:] == ["check.json"]
        report = ["report", "pendulum", "--policy", str(version), "--controller", "c", "--server", pendulum_server.url]
        assert surrogym(*report).code == 0
        assert "On the controller" in (tmp_path / "report.html").read_text()
        checked = said.json["check"]
        assert checked["steps"] == 2 * pendulum().time_limit
        assert (checked["faults"], checked["different_actions"]) == (0, 0)
        assert checked["mean_return"] == pytest.approx(checked["mean_return_of_policy"], rel=1e-3)


@NEEDS_C
def test_checking_a_deployed_controller_in_the_original_environment_counts_real_steps(
    surrogym, server_process, tmp_path
):
    name = f"deploy-{uuid.uuid4().hex[:8]}"
    path = policy_for(tmp_path, cartpole(), name)
    deploy = ["deploy", str(path), "--target", "c", "--out", "c", "--fallback", "0", "--check", "--episodes", "3"]
    with Api(server_process.url) as api:
        api.create_surrogate(name, cartpole())
        said = surrogym(*deploy, "--env", "CartPole-v1", "--server", server_process.url, "--json")
        assert said.code == 0, said.err
        entered = api.surrogate(name).ledger.evaluation
    assert entered == 2 * said.json["check"]["steps"] > 0, "steps of the policy and of the controller"


@pytest.mark.parametrize("trusted", [True, False, None])
def test_deploying_an_untrusted_policy_prints_the_reason_and_the_next_step(surrogym, tmp_path, trusted):
    reason = "the audit failed: speed is off" if trusted is not None else ""
    path = network(tmp_path, pendulum(), (4,), trusted=trusted, reason=reason)
    deploy = ["deploy", str(path), "--target", "c", "--out", "c"]
    said = surrogym(*deploy)
    assert said.code == 0, said.err
    warned = [line for line in said.out.splitlines() if line.startswith("warning")]
    assert len(warned) == (trusted is not True)
    assert all(reason in line and f"surrogym audit {path}" in line for line in warned)
    assert surrogym(*deploy, "--json").json["trusted"] is trusted


def test_a_deployment_that_cannot_be_written_or_checked_writes_nothing(surrogym, tmp_path):
    path = policy_for(tmp_path, pendulum(), None)
    to = ["--target", "c", "--out", "c"]
    for arguments, words in [
        ([str(path), *to, "--range", "speed"], "expected NAME=LOW:HIGH"),
        (["nowhere.zip", *to], "no such policy file"),
        ([str(path), "--target", "plc", "--out", "c"], "expected one of the targets c, arduino"),
        ([str(path), *to, "--fallback", "3"], "--fallback: expected 1 entries"),
        ([str(path), *to, "--check"], "--check needs --env"),
        ([str(path), *to, "--env", "Pendulum-v1"], "--env together with --check"),
        ([str(path), *to, "--check", "--env", "MountainCarContinuous-v0"], "does not fit the environment"),
        ([str(path), "--target", "st", "--out", "c", "--check"], "structured text"),
    ]:
        said = surrogym("deploy", *arguments)
        assert (said.code, words in said.err.replace("\n", " ")) == (1, True), said.err
        assert not (tmp_path / "c").exists()


def test_a_report_refuses_the_controller_check_of_another_policy(surrogym, pendulum_server, tmp_path):
    with Api(pendulum_server.url) as api:
        path = policy_for(tmp_path, api.surrogate("pendulum").spec, "pendulum")
        version = push(api, path).policy.version
    report = ["report", "pendulum", "--policy", str(version), "--controller", ".", "--server", pendulum_server.url]
    said = surrogym(*report)
    assert (said.code, "surrogym deploy --check" in said.err.replace("\n", " ")) == (1, True)
    counts = {"episodes": 1, "steps": 1, "different_actions": 0, "faults": 0}
    numbers = {"largest_difference": 0.0, "mean_return": 0.0, "mean_return_of_policy": 0.0, "microseconds": None}
    write_check(tmp_path, StoredCheck(target="c", environment="here", policy="0" * 64, **counts, **numbers))
    said = surrogym(*report)
    assert (said.code, "got one of another policy" in said.err.replace("\n", " ")) == (1, True)
    assert not (tmp_path / "report.html").exists()


def test_checking_a_controller_without_a_compiler_tells_what_is_missing(surrogym, tmp_path, monkeypatch):
    path = policy_for(tmp_path, pendulum(), None)
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", "/nonexistent")
    for target in ("c", "fmu"):
        check = ["deploy", str(path), "--target", target, "--out", "c", "--period", "0.05", "--check"]
        said = surrogym(*check, "--env", "Pendulum-v1")
        assert (said.code, "expected a C compiler (cc, gcc, clang)" in said.err) == (1, True)
        assert not (tmp_path / "c").exists()


@NEEDS_C
def test_checking_a_controller_uses_the_compiler_in_the_variable_cc(surrogym, tmp_path, monkeypatch):
    check = ["deploy", str(policy_for(tmp_path, pendulum(), None)), "--target", "c", "--out", "c"]
    check += ["--check", "--episodes", "1", "--env", "Pendulum-v1"]
    monkeypatch.setenv("CC", "/nonexistent/cc")
    said = surrogym(*check)
    assert (said.code, "got '/nonexistent/cc'" in said.err) == (1, True)
    assert not (tmp_path / "c").exists()
    compiler = tmp_path / "own-compiler"
    compiler.write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/calls\nexec {shutil.which("cc")} "$@"\n')
    compiler.chmod(0o755)
    monkeypatch.setenv("CC", f"{compiler} -DBY_CC")
    assert surrogym(*check).code == 0
    assert "-DBY_CC" in (tmp_path / "calls").read_text()


@NEEDS_C
def test_deploying_again_into_the_folder_of_the_same_controller_is_accepted(surrogym, tmp_path):
    path = policy_for(tmp_path, pendulum(), None)
    deploy = ["deploy", str(path), "--target", "c", "--out", "c"]
    check = ["--check", "--episodes", "1", "--env", "Pendulum-v1"]
    assert surrogym(*deploy, *check).code == 0
    made = {file: file.read_bytes() for file in (tmp_path / "c").iterdir()}
    assert tmp_path / "c" / "check.json" in made
    assert surrogym(*deploy).code == 0
    assert {file: file.read_bytes() for file in (tmp_path / "c").iterdir()} == made
    assert surrogym(*deploy, *check).code == 0
    (tmp_path / "c" / "pendulum_main.c").unlink(missing_ok=True)
    (tmp_path / "c" / "policy_main.c").unlink(missing_ok=True)
    said = surrogym(*deploy)
    assert (said.code, "check.json: nothing was written" in said.err.replace("\n", " ")) == (1, True)


def test_deploying_a_surrogate_name_is_refused_with_the_form_of_policy_names(surrogym, tmp_path):
    for arguments, words in [
        (["pendulum", "--target", "c"], "pendulum@1 or pendulum@production"),
        (["twin.surrogate", "--target", "onnx"], "of a surrogate only an fmu"),
        (["pendulum", "--target", "fmu", "--trust-policy"], "only --out and --period"),
        (["pendulum", "--target", "fmu", "--env", "Pendulum-v1"], "only --out and --period"),
    ]:
        said = surrogym("deploy", *arguments, "--out", "c")
        assert (said.code, words in said.err.replace("\n", " ")) == (1, True), said.err


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_deploying_to_a_full_disk_gives_a_one_sentence_error_and_leaves_no_file(surrogym, tmp_path, monkeypatch):
    path, whole = policy_for(tmp_path, pendulum(), None), Path.open

    def full(self: Path, mode: str = "r", *arguments, **options):
        if mode == "xb":
            whole(self, mode).close()
            return whole(Path("/dev/full"), "r+b", buffering=0)
        return whole(self, mode, *arguments, **options)

    monkeypatch.setattr(Path, "open", full)
    said = surrogym("deploy", str(path), "--target", "c", "--out", "c")
    assert (said.code, "a file can't be written: No space left on device" in said.err) == (1, True), said.err
    assert list((tmp_path / "c").iterdir()) == []
