"""``surrogym evaluate --learn`` and ``--learn-all``: no real step is taken for nothing, and none is lost."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest

from support.machine import Machine, diary_in
from support.server import RestartingServer
from surrogym.cli.disagreement import Differences
from surrogym.cli.errors import CommandError
from surrogym.cli.learning import Learning, kept
from surrogym_client.transport import Api
from surrogym_sampler import original
from surrogym_sampler.logs import read_log
from surrogym_sampler.logs.importing import Options
from surrogym_shared.archives import stored
from surrogym_shared.wire import NewSample
from surrogym_trainer.evaluation.evaluator import Evaluation, EvaluationSettings, Trace
from surrogym_trainer.evaluation.reporting import as_logged, write_steps
from surrogym_trainer.policies import PolicyCard

MACHINE = ("--env", "support.machine:Machine")


@pytest.fixture
def policy(tmp_path, monkeypatch, name):
    """A policy for the machine that always pushes, as trained for the surrogate ``name``."""
    (tmp_path / "policy.zip").write_bytes(stored({}))
    (tmp_path / "policy.json").write_text(PolicyCard(spec=Machine.spec(None), surrogate=name).model_dump_json())
    monkeypatch.setattr("surrogym_trainer.policies.files.load_policy", lambda *_, **__: lambda o: np.ones((len(o), 1)))
    return "policy.zip"


@pytest.fixture
def diary(tmp_path, monkeypatch):
    with diary_in(tmp_path, monkeypatch) as file:
        yield file


def test_evaluating_with_wait_but_without_learn_is_refused():
    """It was ignored, and a person took the model of before for the one that had learned."""
    with pytest.raises(CommandError, match="expected --wait together with --learn"):
        Differences(wait=5.0).check(EvaluationSettings())
    Differences(wait=5.0, learn_all=True).check(EvaluationSettings())
    Differences(wait=5.0, learn=3).check(EvaluationSettings())


@pytest.mark.parametrize("option", [("--learn-all",), ("--learn", "3")])
def test_evaluating_with_learn_refuses_an_unknown_surrogate_before_any_real_step(on_server, policy, diary, option):
    """All real steps were taken, went nowhere, and the exit status was 0."""
    said = on_server("evaluate", policy, *MACHINE, *option, "--surrogate", "nosuch")
    assert (said.code, "'nosuch'" in said.err) == (1, True), said.err
    assert "step" not in diary.read_text()
    assert "reset" not in diary.read_text()


def test_evaluating_with_learn_reports_an_unreachable_server_before_any_real_step(surrogym, policy, diary):
    """Without --learn-all, it does not stop an evaluation."""
    nowhere = ("--server", "http://127.0.0.1:9")
    said = surrogym("evaluate", policy, *MACHINE, *nowhere, "--learn-all")
    assert (said.code, "surrogym serve" in said.err) == (1, True), said.err
    assert "step" not in diary.read_text()
    assert surrogym("evaluate", policy, *MACHINE, *nowhere, "--episodes", "1").code == 0
    assert "step" in diary.read_text()


def test_evaluating_with_learn_all_without_a_surrogate_is_refused(surrogym, policy, diary, tmp_path):
    (tmp_path / "policy.json").write_text(PolicyCard(spec=Machine.spec(None)).model_dump_json())
    said = surrogym("evaluate", policy, *MACHINE, "--learn-all")
    assert (said.code, "expected --surrogate with --learn-all, got none" in said.err) == (1, True), said.err
    assert "step" not in diary.read_text()


def test_evaluating_with_learn_refuses_a_surrogate_of_another_system_before_any_real_step(
    on_server, policy, diary, name
):
    """All real steps were taken, and not added: their coordinates were others."""
    assert on_server("register", "Pendulum-v1", "--name", name).code == 0
    said = on_server("evaluate", policy, *MACHINE, "--learn-all")
    assert (said.code, "can't learn from these steps: expected coordinates (theta, " in said.err) == (1, True), said.err
    assert set(diary.read_text().split()) == {"open", "close"}


def test_evaluating_with_learn_is_refused_for_a_surrogate_without_a_model(
    on_server, server_process, policy, diary, name
):
    """--learn was ignored without a word."""
    with Api(server_process.url) as api:
        api.create_surrogate(name, Machine.spec(None))
    said = on_server("evaluate", policy, *MACHINE, "--learn", "3")
    assert (said.code, "has no model yet: --learn-all adds every step" in said.err) == (1, True), said.err
    assert "step" not in diary.read_text()


def test_evaluating_with_learn_all_adds_every_step_to_a_surrogate_without_a_model(
    on_server, server_process, policy, diary, name
):
    """--learn-all was ignored without a word until there was a model to compare with."""
    with Api(server_process.url) as api:
        api.create_surrogate(name, Machine.spec(None))
        said = on_server("evaluate", policy, *MACHINE, "--episodes", "2", "--learn-all", "--no-push")
        assert said.code == 0, said.err
        taken = diary.read_text().count("step")
        assert f"not compared with a model: {name!r} has no model yet" in said.out
        assert f"the model learns from {taken} real steps" in said.out
        assert api.surrogate(name).ledger.logged == taken
    assert not list(diary.parent.glob("*.steps.npz")), "stored steps need no file"


@pytest.mark.timeout(600)
def test_real_steps_that_a_killed_server_did_not_store_are_saved_in_a_file_and_sent_later(
    surrogym, policy, diary, name, tmp_path, monkeypatch
):
    """They were lost, and the exit status was 0."""
    (tmp_path / "server").mkdir()
    server = RestartingServer(tmp_path / "server")

    class Killing(Api):
        """A client whose server is killed after it has stored five steps."""

        def add_samples(self, name, sampler, samples, **options):
            super().add_samples(name, sampler, samples[:5], **options | {"complete": False})
            server.stop(signal.SIGKILL)
            return super().add_samples(name, sampler, samples[5:], **options)

    try:
        with Api(server.url) as api:
            api.create_surrogate(name, Machine.spec(None))
            with monkeypatch.context() as patch:
                patch.setattr("surrogym_client.transport.api.Api", Killing)
                all_steps = ("--episodes", "2", "--learn-all", "--json", "--server", server.url)
                said = surrogym("evaluate", policy, *MACHINE, *all_steps)
            taken = diary.read_text().count("step")
            assert said.code == 1
            assert said.json["steps"] == taken, "the result is printed although the steps were not sent"
            assert f"error: --learn-all: no Surrogym server answers at {server.url}" in said.err
            assert f"5 of {taken} real steps are known to be stored; all are in policy.steps.npz" in said.err
            command = said.err.strip().rpartition(": surrogym ")[2]
            assert command == f"import policy.steps.npz --to {name} --server {server.url}"
            server.start()
            assert api.surrogate(name).ledger.logged == 5
            imported = surrogym(*command.split(), "--wait", "200", "--json")
            assert imported.code == 0, imported.err
            assert (imported.json["sent"], imported.json["duplicates"]) == (taken, 5)
            view = api.surrogate(name)
            assert (view.ledger.logged, view.fidelity.samples) == (taken, taken), "a fit was due"
    finally:
        server.stop()


def test_a_file_of_real_steps_not_yet_sent_is_not_overwritten(tmp_path):
    spec = Machine.spec(None)
    step = NewSample(coordinates=[0.0], action=[1.0], next_coordinates=[0.1], reward=0.0, terminated=False)
    files = [write_steps(tmp_path / "policy.zip", spec, [step] * count) for count in (1, 2)]
    assert [file.name for file in files] == ["policy.steps.npz", "policy.steps-2.npz"]
    assert [len(read_log(file, Options(spec=spec)).table) for file in files] == [1, 2]


def test_unsent_real_steps_are_saved_in_the_working_folder_if_the_policys_is_unwritable(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    step = NewSample(coordinates=[0.0], action=[1.0], next_coordinates=[0.1], reward=0.0, terminated=False)
    assert write_steps(tmp_path / "gone" / "policy.zip", Machine.spec(None), [step]) == Path("policy.steps.npz")


def test_real_steps_of_an_interrupted_evaluation_are_saved_in_a_file_that_it_names(tmp_path, capsys):
    """Ctrl-C while the steps were sent lost the others."""
    learning = Learning("pend", "--learn-all", Machine.spec(None), "http://127.0.0.1:9")
    path = np.array([[0.0], [0.1], [0.2]])
    result = Evaluation(np.zeros(1), np.array([2]), None, (Trace(path, np.ones((2, 1)), np.zeros(2)),))
    interrupted = pytest.raises(KeyboardInterrupt)
    with interrupted, kept(learning, tmp_path / "policy.zip", result, quiet=True):
        raise KeyboardInterrupt
    said = capsys.readouterr().err
    assert f"0 of 2 real steps are known to be stored; all are in {tmp_path / 'policy.steps.npz'}" in said


def test_real_steps_with_unstorable_numbers_do_not_prevent_storing_the_others(tmp_path, capsys):
    learning = Learning("pend", "--learn-all", Machine.spec(None))
    path = np.array([[0.0], [0.1], [0.2]])
    result = Evaluation(np.zeros(1), np.array([2]), None, (Trace(path, np.ones((2, 1)), np.array([0.0, np.inf])),))
    with kept(learning, tmp_path / "policy.zip", result, quiet=False) as steps:
        assert [sample.coordinates for sample in steps.samples] == [[0.0]]
    assert "left out: 1 real step with numbers that are not finite" in capsys.readouterr().err


def test_angles_of_real_steps_are_wrapped_exactly_as_by_a_log_import():
    """The server knows a log by its numbers, so one with another last bit would be stored twice."""
    spec = original.make("Pendulum-v1").spec()
    angles = np.random.default_rng(0).uniform(-20, 20, size=(500, 2))
    steps = [
        NewSample(coordinates=[a, 0.5], action=[0.1], next_coordinates=[b, 0.5], reward=-1.0, terminated=False)
        for a, b in angles.tolist()
    ]
    sent = as_logged(spec, [*steps, *steps])
    assert len(sent) == 2 * len(steps), "equal steps all count"
    assert as_logged(spec, sent) == sent
    assert all(-np.pi <= one.coordinates[0] < np.pi for one in sent)
