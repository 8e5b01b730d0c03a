"""``surrogym prior``: from a rough simulator to a design that needs few real steps; bad use changes nothing."""

from __future__ import annotations

import json
import threading

import pytest

from support.hinge import PERIOD, Real, hinge_spec, sent
from support.noting import until
from surrogym_client.transport import Api
from surrogym_client.transport.priors import PriorCalls
from surrogym_sampler.priors import prior
from surrogym_sampler.queries.settings import SamplerSettings
from surrogym_sampler.queries.worker import Sampler

PARAMETERS = ("-p", "mass", "-p", "length", "-p", "friction=0.1..0.8")


@pytest.fixture
def hinge(server_process, name):
    with Api(server_process.url) as api:
        api.create_surrogate(name, hinge_spec(design={"budget": 30, "initial": 4}))
        yield name
        api.delete_surrogate(name)


def test_with_a_calibrated_simulator_prior_the_design_needs_few_real_steps(on_server, server_process, hinge):
    with Api(server_process.url) as api:
        PriorCalls(api.connection).wait(hinge)
        sampler = Sampler(api, hinge, Real(), SamplerSettings(until_done=True, wait_seconds=1.0))
        beside = threading.Thread(target=sampler.run)
        beside.start()
        said = on_server("prior", hinge, "support.hinge:Textbook", *PARAMETERS, "--steps", "60", "--json")
        beside.join()
        assert until(lambda: api.surrogate(hinge).phase != "fitting"), "the prior's last calibration is fitted too"
        view, others = api.surrogate(hinge), [one.name for one in api.surrogates()]
    assert said.code == 0
    result = json.loads(said.out)
    about = result["prior"]["about"]
    found = {one["name"]: one["value"] for one in about["parameters"]}
    assert found == pytest.approx({"mass": Real.mass, "length": Real.length, "friction": Real.friction}, rel=1e-3)
    assert about["error"] < 1e-3 < about["error_before"]
    assert (view.phase, result["phase"]) == ("ready", "ready")
    assert view.ledger.total <= 10
    assert not [name for name in others if ".simulator-" in name]


def test_a_simulator_that_prints_and_fails_in_some_states_can_be_used_as_prior(on_server, server_process, hinge):
    with Api(server_process.url) as api:
        PriorCalls(api.connection).wait(hinge)
        sampler = Sampler(api, hinge, Real(), SamplerSettings(until_done=True, wait_seconds=1.0))
        beside = threading.Thread(target=sampler.run)
        beside.start()
        said = on_server("prior", hinge, "support.hinge:Partial", "--steps", "60", "--json")
        beside.join()
    assert said.code == 0
    assert json.loads(said.out)["prior"]["about"]["source"] == "support.hinge:Partial"


@pytest.fixture
def sampled(server_process, name):
    """A surrogate with eight real steps, whose design takes no more."""
    with Api(server_process.url) as api:
        api.create_surrogate(name, hinge_spec(design={"budget": 0}, sampling_period=PERIOD))
        sent(api, name, 8)
        assert until(lambda: api.surrogate(name).round), "the fit without a prior"
        yield name
        api.delete_surrogate(name)


def test_the_status_shows_the_calibration_and_the_outputs_that_use_the_prior(on_server, sampled):
    said = on_server("prior", sampled, "support.hinge:Textbook", *PARAMETERS, "--steps", "60")
    assert said.code == 0
    assert "outputs that use it: angle, speed" in said.out
    assert said.out in on_server("status", sampled).out


def test_an_uncertain_model_of_a_simulator_is_learned_from_more_steps_on_the_server(on_server, sampled, monkeypatch):
    for name, value in (("BY_INPUT", 5), ("FEWEST", 10), ("FURTHER", 80)):
        monkeypatch.setattr(prior, name, value)
    said = on_server("prior", sampled, "support.hinge:Stiff", *PARAMETERS, "--json")
    assert said.code == 0
    assert said.json["prior"]["about"]["simulated_steps"] == 80


def test_the_command_prior_says_that_the_model_of_the_simulator_is_not_certain(on_server, sampled):
    said = on_server("prior", sampled, "support.hinge:Stiff", *PARAMETERS, "--steps", "15")
    assert "a model of 15 of its steps is not certain (confidence index 0." in said.out


def test_a_prior_in_other_units_is_said_to_have_too_large_errors_and_the_design_goes_without_it(on_server, sampled):
    said = on_server("prior", sampled, "support.hinge:Degrees", "-p", "mass", "--steps", "60")
    assert said.code == 0
    assert "larger than the changes themselves: check the units" in said.out
    assert "outputs that use it: none" in said.out


def test_a_prior_with_another_sampling_period_is_refused(on_server, sampled):
    said = on_server("prior", sampled, "support.hinge:Faster")
    assert said.code != 0
    assert "a step every 0.1 s" in said.err


def test_a_prior_that_fails_at_most_real_steps_says_how_the_design_continues(on_server, sampled):
    said = on_server("prior", sampled, "support.hinge:Elsewhere")
    assert said.code != 0
    assert "the solver diverged" in said.err
    assert f"surrogym prior {sampled} --drop" in said.err


def test_the_command_prior_says_at_how_many_real_steps_the_simulator_fails(on_server, sampled):
    said = on_server("prior", sampled, "support.hinge:Partial", *PARAMETERS, "--steps", "60")
    assert said.code == 0
    assert "0.00% calibrated, on 5 real steps" in said.out
    assert "it fails at 3 other real steps" in said.out


def test_invalid_uses_of_the_prior_command_are_refused_and_change_nothing(on_server, server_process, hinge):
    refused = {
        ("prior", hinge): "got none",
        ("prior", hinge, "support.hinge:Textbook", "--drop"): "got both",
        ("prior", hinge, "support.hinge:Textbook", "-p", "weight"): "friction, length, mass",
        ("prior", hinge, "support.hinge:Nothing"): "support.hinge:Nothing",
        ("prior", hinge, "nothing.surrogate"): "no file",
        ("prior", hinge, "surrogate:other", "-p", "mass"): "is a learned model: leave them out",
        ("prior", hinge, "surrogate:nobody"): "nobody",
        ("prior", hinge, f"surrogate:{hinge}"): "itself",
        ("prior", hinge, "support.hinge:Renamed"): "rate",
        ("prior", hinge, "support.hinge:Weaker"): "0.5",
        ("prior", hinge, "support.hinge:Broken"): "the solver diverged",
        ("prior", hinge, "support.hinge:Noisy", "-p", "mass"): "same result twice",
        ("prior", "nobody", "support.hinge:Textbook"): "nobody",
    }
    for arguments, words in refused.items():
        said = on_server(*arguments)
        assert said.code != 0
        assert words in said.err
    with Api(server_process.url) as api:
        assert not PriorCalls(api.connection).get(hinge).awaited


def test_the_command_prior_drop_ends_a_designs_waiting_for_a_simulator_prior(on_server, server_process, hinge):
    with Api(server_process.url) as api:
        PriorCalls(api.connection).wait(hinge)
        assert "waits for its prior" in on_server("status", hinge).out
        assert on_server("prior", hinge, "--drop").code == 0
        assert "prior" not in on_server("status", hinge).out
        assert not PriorCalls(api.connection).get(hinge).awaited
