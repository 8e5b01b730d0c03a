"""The commands against a live server, in the order a person uses them."""

import csv
import json
import re
import threading

import numpy as np
import pytest

from support.machine import Machine, diary_in
from support.moody import DECLARED
from surrogym.cli.commands.train import _trainable
from surrogym_client.surrogates.waiting import COMPLETED
from surrogym_client.transport import Api
from surrogym_sampler import original
from surrogym_sampler.original.classic import pendulum as pendulum_spec
from surrogym_sampler.original.loading import with_choices
from surrogym_sampler.queries import Sampler, SamplerSettings
from surrogym_shared.archives import stored
from surrogym_shared.spec import Design
from surrogym_trainer.policies import PolicyCard
from surrogym_trainer.policies.evidence import Promise
from surrogym_trainer.training import TrainSettings

OWN = """
from surrogym_sampler.original import RealStep
from surrogym_shared.spec import *

class Cart:
    def spec(self):
        return EnvironmentSpec(
            environment="own_line:Cart",
            coordinates=(Coordinate(name="x", sampling=Uniform(low=-1, high=1)),),
            observation=(ObservationEntry(name="x", term=Term.linear(x=1)),),
            action=BoxAction(low=(-1.0,), high=(1.0,)),
            start={"x": Uniform(low=-0.5, high=0.5)},
            time_limit=20,
            design=Design(initial=4, budget=4),
        )

    def step_from(self, coordinates, action):
        return RealStep(coordinates, action, coordinates + 0.1 * action, reward=-abs(coordinates[0]))

    def close(self):
        pass
"""


@pytest.fixture
def pendulum(on_server, name):
    said = on_server("register", "Pendulum-v1", "--name", name, "--budget", "8", "--initial", "4", "--json")
    assert said.code == 0
    assert said.json["budget"] == 8
    return name


def test_the_register_command_prints_the_next_command(on_server, name):
    said = on_server("register", "CartPole-v1", "--name", name)
    assert said.code == 0
    assert said.out == (
        f"{name}: CartPole-v1, 4 coordinates, budget of {_budget(said)} real steps, target 0.999; "
        f"next: surrogym sample {name}\n"
    )


def test_registering_from_a_file_prints_the_next_command_with_its_environment(on_server, name, tmp_path):
    own = original.make("Pendulum-v1").spec().model_copy(update={"environment": "own_line:Env-v0"})
    (tmp_path / "env.json").write_text(own.model_dump_json())
    said = on_server("register", name, str(tmp_path / "env.json"))
    assert said.out.endswith(f"next: surrogym sample {name} --env own_line:Env-v0\n")


def test_a_surrogate_with_budget_0_recommends_import_instead_of_sample(on_server, name):
    """register named the sampler as the next step, and sample --until-done waited without a word."""
    words = "the design requests no real steps, and there is no log yet; next: surrogym import LOG --to " + name
    said = on_server("register", "Pendulum-v1", "--name", name, "--budget", "0")
    assert said.out == f"{name}: Pendulum-v1, 2 coordinates; {words}\n"
    assert on_server("sample", name, "--until-done").out == f"{words}\n"
    assert on_server("sample", name, "--until-done", "--json").json["steps"] == 0
    waits = on_server("sample", name, "--time-limit", "0.5")
    assert f"{words}; this sampler waits for queries, Ctrl-C ends it" in waits.err
    assert words in on_server("status", name).out


def test_registering_twice_is_harmless_and_another_specification_is_refused(on_server, pendulum):
    again = on_server("register", "Pendulum-v1", "--name", pendulum, "--budget", "8", "--initial", "4")
    assert again.code == 0
    other = on_server("register", "CartPole-v1", "--name", pendulum)
    assert other.code == 1
    assert pendulum in other.err


def test_tolerances_can_be_given_to_register_and_changed_later(on_server, name):
    registered = on_server("register", "Pendulum-v1", "--name", name, "--tolerance", "theta=0.01", "--json")
    assert registered.json["spec"]["tolerances"] == {"theta": 0.01}
    assert on_server("change", name, "--tolerance", "reward=0.5", "--json").json["tolerances"] == {"reward": 0.5}
    for bad, words in (("angle=1", "'angle'"), ("theta=-1", "greater than 0"), ("theta", "output=number")):
        said = on_server("register", "Pendulum-v1", "--name", name, "--tolerance", bad)
        assert said.code == 1
        assert words in said.err


def test_print_spec_needs_no_server_and_register_accepts_its_output(surrogym, on_server, name, tmp_path):
    said = surrogym("register", "Pendulum-v1", "--seed", "5", "--bins", "3", "--print-spec")
    assert said.code == 0
    assert said.json["design"]["seed"] == 5
    (tmp_path / "spec.json").write_text(said.out)
    registered = on_server("register", "--spec", "spec.json", "--name", name, "--json")
    assert registered.json["spec"]["action"]["bins"] == [3]


def test_the_status_command_lists_all_surrogates_or_shows_one(on_server, pendulum):
    everything = on_server("status", "--json").json
    assert pendulum in [s["name"] for s in everything["surrogates"]]
    assert f"{pendulum}" in on_server("status").out
    one = on_server("status", pendulum)
    assert f"{pendulum}: Pendulum-v1, sampling" in one.out or "collecting" in one.out
    assert "real steps: 0 of 8\nin the budget: 0 initial, 0 adaptive, 0 manual\n" in one.out


def test_samples_taken_by_the_sample_command_appear_in_status_and_export(on_server, pendulum, tmp_path):
    said = on_server("sample", pendulum, "--max-queries", "4", "--time-limit", "60", "--json")
    assert said.code == 0
    assert (said.json["answered"], said.json["failed"]) == (4, 0)
    assert said.err.count("answered") == 4
    assert "4 initial" in on_server("status", pendulum).out
    assert on_server("export", pendulum, "--out", "samples.csv").code == 0
    assert on_server("export", pendulum, "-o", "samples.npz", "--quiet").out == ""
    with (tmp_path / "samples.csv").open() as file:
        assert len(list(csv.reader(file))) == 5
    with np.load(tmp_path / "samples.npz") as arrays:
        assert all(len(arrays[key]) == 4 for key in arrays.files if arrays[key].ndim == 2)


def test_a_surrogate_can_be_exported_to_a_file_and_imported(surrogym, pendulum_server, name):
    server = ("--server", pendulum_server.url)
    assert surrogym("export", "pendulum", "--out", "pendulum.surrogate", *server).code == 0
    entered = surrogym("import", "pendulum.surrogate", "--name", name, *server)
    assert entered.out == (
        f"{name}: Pendulum-v1, model 1 and 12 real samples (there 12 initial), design paused; "
        f"next: surrogym train {name}\n"
    )
    taken = surrogym("import", "pendulum.surrogate", "--quiet", *server)
    assert taken.code == 1
    assert re.match("error: .*'pendulum'.*--name\n$", taken.err)


def test_exporting_a_surrogate_without_a_model_is_refused(on_server, pendulum):
    said = on_server("export", pendulum, "--out", "pendulum.surrogate")
    assert (said.code, said.out) == (1, "")
    assert "has no model yet" in said.err


def test_an_export_waits_for_the_first_fit(on_server, pendulum):
    """It said that a sampler had to answer the first queries, which were answered."""
    assert on_server("sample", pendulum, "--max-queries", "4", "--quiet").code == 0
    assert on_server("export", pendulum, "--out", "early.surrogate").code == 0


def test_training_without_a_model_recommends_sampling_or_waiting(on_server, server_process, pendulum):
    """A person who starts the training a second after the sampler is told nothing: the training waits."""
    missing = f"error: '{pendulum}' has no model yet, its phase is "
    assert on_server("sample", pendulum, "--max-queries", "1", "--quiet").code == 0
    said = on_server("train", pendulum, "--quiet")
    assert said.err.startswith(missing)
    assert said.err.endswith(f"run surrogym sample {pendulum}, or give --wait SECONDS\n"), "a sampler that has ended"
    with Api(server_process.url) as api:
        api.claim(pendulum, "a sampler at work")
    said = on_server("train", pendulum, "--quiet", "--wait", "0")
    assert said.err.startswith(missing)
    assert said.err.endswith(": leave --wait out, and the training begins after the design\n")


def test_training_waits_for_a_design_on_which_a_sampler_is_at_work_or_starts(server_process, name):
    spec = pendulum_spec().model_copy(update={"design": Design(budget=12)})
    with Api(server_process.url) as api, Api(server_process.url) as own:
        api.create_surrogate(name, spec)
        sampler = Sampler(own, name, original.make("Pendulum-v1"), SamplerSettings(name="thread", wait_seconds=0.5))
        thread = threading.Timer(0.5, sampler.run)
        thread.start()
        try:
            _trainable(name, server_process.url, None, None, TrainSettings(), quiet=True)
            assert api.surrogate(name).phase in COMPLETED, "it said that there is no model yet"
        finally:
            sampler.stop()
            thread.join()


def test_the_improve_command_adds_queries(on_server, pendulum):
    assert on_server("improve", pendulum, "--queries", "3").code == 0


def test_the_delete_command_asks_for_confirmation(on_server, pendulum, monkeypatch):
    monkeypatch.setattr("typer.confirm", _no)
    assert on_server("delete", pendulum).code == 1
    assert on_server("status", pendulum).code == 0
    assert on_server("delete", pendulum, "--yes").out == f"{pendulum} deleted\n"
    assert on_server("status", pendulum).code == 1


def test_the_error_of_train_without_a_model_recommends_a_command(on_server, pendulum):
    said = on_server("train", pendulum)
    assert said.code == 1
    assert f"run surrogym sample {pendulum}" in said.err


def test_the_sample_command_refuses_a_user_defined_environment_class_unless_given_with_env(
    on_server, name, tmp_path, monkeypatch
):
    """The server's word is never enough to import a module."""
    (tmp_path / "own_line.py").write_text(OWN)
    monkeypatch.syspath_prepend(str(tmp_path))
    registered = on_server("register", "own_line:Cart", "--name", name)
    assert registered.out.endswith(f"next: surrogym sample {name} --env own_line:Cart\n")
    hint = f"queries wait for a sampler; next: surrogym sample {name} --env own_line:Cart"
    assert hint in on_server("status", name).out, "without --env the command is refused"
    assert f"run surrogym sample {name} --env own_line:Cart," in on_server("train", name).err
    refused = on_server("sample", name, "--once")
    assert refused.code == 1
    assert "expected --env own_line:Cart" in refused.err
    said = on_server("sample", name, "--env", "own_line:Cart", "--max-queries", "4", "--time-limit", "60", "--json")
    assert said.json["answered"] == 4


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_commands_sample_train_and_evaluate_work_in_sequence(on_server, server_process, pendulum, tmp_path):
    assert on_server("sample", pendulum, "--until-done", "--time-limit", "300", "--quiet").code == 0
    session = ("--variant", "pathwise", "--trust", "9", "--process-noise", "--start-box", "0.25")
    options = ("--steps", "2000", "--num-envs", "4", "--seed", "3", *session)
    trained = on_server("train", pendulum, *options, "--json", "--quiet")
    assert trained.code == 0, trained.err
    card = json.loads((tmp_path / "policy.json").read_text())
    assert card["settings"]["session"] == {"variant": "pathwise", "process_noise": True, "trust": 9.0}
    assert card["settings"]["start_box"] == 0.25
    assert (card["surrogate"], card["seed"]) == (pendulum, 3)
    assert 0 < card["virtual_steps"] == trained.json["virtual_steps"] <= 2000
    assert trained.json["version"] == 1
    besides = ("--compare", "zero", "--reference", "policy.zip")
    changed = on_server("evaluate", "policy.zip", "--learn", "4", "--perturb", "0.1")
    assert (changed.code, "got --perturb" in changed.err) == (1, True)
    nothing = on_server("evaluate", "policy.zip", "--explore", "nan")
    assert (nothing.code, "'--explore': expected a finite number, got nan" in nothing.err) == (2, True)
    compared = on_server("evaluate", "policy.zip", "--compare", "zero", "--explore", "0.1")
    assert (compared.code, "--compare without --explore" in compared.err) == (1, True)
    evaluated = on_server("evaluate", "policy.zip", "--episodes", "3", *besides, "--learn", "4", "--json", "--quiet")
    assert evaluated.code == 0, evaluated.err
    assert (evaluated.json["version"], evaluated.json["steps"], evaluated.json["without"]["steps"]) == (1, 600, 600)
    assert evaluated.json["reference"]["per_episode"] == evaluated.json["per_episode"]  # it is the policy itself
    assert evaluated.json["disagreements"]["compared"] == 400
    assert [episode["seed"] for episode in evaluated.json["disagreements"]["episodes"]] == [10_000, 10_001, 10_002]
    assert len(evaluated.json["per_episode"]) == 3
    with Api(server_process.url) as api:
        ledger = api.surrogate(pendulum).ledger
    differing = evaluated.json["disagreements"]
    assert ledger.evaluation == 1800
    assert len(differing["steps"]) <= ledger.logged == differing["learned"] <= 4, (
        "also steps that explain a loss together"
    )
    every = on_server("evaluate", "policy.zip", "--episodes", "1", "--learn-all", "--wait", "100", "--json", "--quiet")
    with Api(server_process.url) as api:
        view = api.surrogate(pendulum)
    new = every.json["disagreements"]["learned"]
    assert 200 - ledger.logged <= new <= 200, "all steps of an episode, less those of the same start above"
    assert view.ledger.logged == ledger.logged + new
    assert view.fidelity.samples == view.samples, "the command waits for the model that has learned from them"
    both = on_server("evaluate", "policy.zip", "--learn", "4", "--learn-all")
    assert (both.code, "expected --learn or --learn-all, got both" in both.err) == (1, True)
    few = on_server("evaluate", "policy.zip", "--episodes", "3")
    assert few.out.splitlines()[2] == "3 episodes are too few to judge the promise: take 30 or more"
    unaudited = on_server("audit", "policy.zip")  # the sampler has ended
    assert (unaudited.code, f"start surrogym sample {pendulum} in another" in unaudited.err) == (1, True), unaudited.err
    _look_at(on_server, pendulum, tmp_path)
    nothing = on_server("sample", pendulum, "--max-queries", "1", "--time-limit", "0.5")
    assert "None" not in nothing.out
    other = on_server("evaluate", "policy.zip", "--env", "CartPole-v1", "--episodes", "1")
    assert other.code == 1
    assert "error: the policy does not fit the environment" in other.err


def test_evaluating_a_policy_with_binned_actions_sends_the_decoded_actions(surrogym, monkeypatch, tmp_path):
    spec = with_choices(Machine.spec(None), {}, bins=5)
    (tmp_path / "policy.zip").write_bytes(stored({}))
    (tmp_path / "policy.json").write_text(PolicyCard(spec=spec).model_dump_json())
    monkeypatch.setattr("surrogym_trainer.policies.files.load_policy", lambda *_, **__: lambda o: np.ones(len(o)))
    with diary_in(tmp_path, monkeypatch) as diary:
        said = surrogym("evaluate", "policy.zip", "--env", "support.machine:Machine", "--episodes", "1")
        assert said.code == 0, said.err
        assert set(diary.read_text().splitlines()) == {"open", "reset 10000", "step -0.5", "close"}


def test_the_evaluate_command_reports_that_all_episodes_were_equal(surrogym, monkeypatch, tmp_path):
    """A hundred equal episodes of a deterministic plant looked like a hundred that agree."""
    (tmp_path / "policy.zip").write_bytes(stored({}))
    (tmp_path / "policy.json").write_text(PolicyCard().model_dump_json())
    monkeypatch.setattr("surrogym_trainer.policies.files.load_policy", lambda *_, **__: lambda o: np.ones((len(o), 1)))
    said = surrogym("evaluate", "policy.zip", "--env", "support.moody:Alike", "--episodes", "4")
    assert said.code == 0, said.err
    assert said.out.splitlines()[-1] == (
        "all 4 episodes are equal in every number: nothing in them was random, so each shows the same return, with 5 "
        "real steps"
    )
    assert said.err.count("the evaluation takes 4 real episodes in support.moody:Alike: at most 20 real steps\n") == 1
    assert "the first 3 of 4 episodes are equal in every number" in said.err
    compared = surrogym(
        "evaluate", "policy.zip", "--env", "support.moody:Alike", "--episodes", "4", "--compare", "zero"
    )
    assert (
        compared.err.count("the evaluation takes 8 real episodes in support.moody:Alike: at most 40 real steps\n") == 1
    )
    several = surrogym("evaluate", "policy.zip", "--env", "support.moody:Line", "--episodes", "4")
    assert "equal" not in several.out + several.err


def test_the_evaluate_command_reports_returns_for_the_set_points_of_the_card(surrogym, monkeypatch, tmp_path):
    (tmp_path / "policy.zip").write_bytes(stored({}))
    card = PolicyCard(spec=DECLARED, settings={"session": {"set_points": {"x": 0.25}}})
    (tmp_path / "policy.json").write_text(card.model_dump_json())
    monkeypatch.setattr("surrogym_trainer.policies.files.load_policy", lambda *_, **__: lambda o: np.ones((len(o), 1)))
    arguments = ("evaluate", "policy.zip", "--env", "support.moody:Alike", "--episodes", "1")
    said = surrogym(*arguments)
    assert said.code == 0, said.err
    assert "returns are for the set point x = 0.25, by the declared reward of the policy's card" in said.out
    # x is 0.25, 0.35, ..., 0.65
    assert json.loads(surrogym(*arguments, "--json").out)["per_episode"] == [pytest.approx(-1.0)]
    promise = Promise(median=-1.0, low=-1.1, high=-0.9, functions=32, episodes=256)
    blind = card.model_copy(update={"spec": None, "promise": promise})
    (tmp_path / "policy.json").write_text(blind.model_dump_json())
    said = surrogym(*arguments[:-1], "40", "--json")
    assert json.loads(said.out)["per_episode"][0] == pytest.approx(-2.25)
    assert json.loads(said.out)["promise_kept"] is None
    assert "the promise for the set point x = 0.25 is not judged" in surrogym(*arguments).out


def test_the_evaluate_command_says_how_episodes_kept_the_limits_of_a_planner(surrogym, monkeypatch, tmp_path):
    (tmp_path / "policy.zip").write_bytes(stored({}))
    card = PolicyCard(spec=DECLARED, settings={"limits": ["x<=0.6", "x<=0.9", "y<=1"]})
    (tmp_path / "policy.json").write_text(card.model_dump_json())
    monkeypatch.setattr("surrogym_trainer.policies.files.load_policy", lambda *_, **__: lambda o: np.ones((len(o), 1)))
    said = surrogym("evaluate", "policy.zip", "--env", "support.moody:Alike", "--episodes", "2")
    assert said.code == 0, said.err  # x is 0.25, 0.35, ..., 0.75
    assert "limit x<=0.6: 2 of 2 episodes left it; least distance -0.15" in said.out
    assert "limit x<=0.9: 0 of 2 episodes left it; least distance 0.15" in said.out
    assert "limit 'y<=1': expected a sum of coordinates" in said.out


def test_the_evaluate_command_shows_a_policy_the_integrals_of_its_card(surrogym, monkeypatch, tmp_path):
    shown = []

    def policy(observations):
        shown.append(observations[0].tolist())
        return np.full((len(observations), 1), -0.5)

    (tmp_path / "policy.zip").write_bytes(stored({}))
    (tmp_path / "policy.json").write_text(PolicyCard(spec=DECLARED, settings={"integral": ["x"]}).model_dump_json())
    monkeypatch.setattr("surrogym_trainer.policies.files.load_policy", lambda *_, **__: policy)
    said = surrogym("evaluate", "policy.zip", "--env", "support.moody:Alike", "--episodes", "1")
    assert said.code == 0, said.err
    # An error of 0.1, which is 5 % of the sampling range, counts 1, and the sum is clipped to 1.
    assert np.round(shown, 6).tolist() == [[0.25, 0], [0.2, 1], [0.15, 1], [0.1, 1], [0.05, 1]]


def _look_at(on_server, pendulum, tmp_path):
    """The policy that the server keeps, by its commands."""
    assert "production leads to version 1" in on_server("policy", "alias", f"{pendulum}@1", "production").out
    listed = on_server("policies", pendulum).out
    assert f"{pendulum}@1" in listed
    assert "production" in listed
    shown = on_server("policy", f"{pendulum}@production").out
    assert re.search(r"zero +its own +declared starts, from seed 10000 +3 ", shown)
    assert re.search(r"reference +its own +declared starts, from seed 10000 +3 ", shown)
    taken = on_server("policy", "get", f"{pendulum}@production", "--out", "taken.zip")
    assert taken.code == 0, taken.err
    assert (tmp_path / "taken.zip").read_bytes() == (tmp_path / "policy.zip").read_bytes()
    assert PolicyCard.model_validate_json((tmp_path / "taken.json").read_text()).surrogate == pendulum
    pushed = on_server("policy", "push", "taken.zip")
    assert pushed.out.startswith(f"{pendulum}@1: known already")
    unknown = on_server("policy", f"{pendulum}@7")
    assert (unknown.code, "got 7, which does not exist" in unknown.err) == (1, True)
    deleted = on_server("policy", "delete", f"{pendulum}@1").out
    assert deleted == f"{pendulum}@1 is deleted, and nothing is left at {pendulum}@production\n"


def _no(*_, **__):
    import typer

    raise typer.Abort


def _budget(said):
    return said.out.split("budget of ")[1].split()[0]
