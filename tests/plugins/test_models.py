"""A family of models from another package: installed, held to the laws, and used for all of Pendulum over HTTP."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from support.server import ServerProcess
from support.teaching import teach
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum
from surrogym_server.models.registry import MODELS
from surrogym_server.testing import LAWS_OF_MODELS, ModelCase, model_cases
from surrogym_shared.spec import EnvironmentSpec, ModelChoice

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "plugins" / "model"
CASES = ("learned reward", "learned end", "discrete actions")


def designed(model: str | ModelChoice) -> EnvironmentSpec:
    design = pendulum().design.model_copy(update={"model": model})
    return pendulum().model_copy(update={"design": design})


def surrogym(server: ServerProcess, folder: Path, *words: str) -> str:
    """What a command of a user's terminal prints."""
    command = [sys.executable, "-m", "surrogym", *words]
    with_server = command if words[0] == "evaluate" else [*command, "--server", server.url]
    made = subprocess.run(with_server, cwd=folder, capture_output=True, text=True, check=False, timeout=240)
    assert made.returncode == 0, made.stdout + made.stderr
    return made.stdout


@pytest.fixture(scope="module")
def taught(plugin_server: ServerProcess) -> str:
    """Name of a Pendulum that the installed family has learned."""
    with Api(plugin_server.url) as api:
        teach(api, "linear", designed("bayesian_linear"), queries=16, initial=12)
    return "linear"


@pytest.mark.timeout(600)  # on a machine that others use as well
def test_sampling_fitting_and_training_work_with_an_installed_model_plugin(
    plugin_server: ServerProcess, taught: str, tmp_path: Path
):
    status = json.loads(surrogym(plugin_server, tmp_path, "status", taught, "--json"))
    assert status["phase"] in ("ready", "over_budget")
    assert status["fidelity"]["outputs"][0]["structure"] == "linear in features and their squares"
    small = ("--steps", "2048", "--num-envs", "16", "--quiet")
    surrogym(plugin_server, tmp_path, "train", taught, "--out", "policy.zip", *small)
    surrogym(plugin_server, tmp_path, "evaluate", "policy.zip", "--env", "Pendulum-v1", "--episodes", "1", "--quiet")
    said = predicted(plugin_server, taught, [1.0, 2.0], [0.5])
    assert said["next_coordinates"][0][1] == pytest.approx(2.0 + 0.05 * (15 * 0.8414709848 + 3 * 0.5), abs=1e-3)


def predicted(server: ServerProcess, name: str, q: list[float], u: list[float]) -> dict[str, list[list[float]]]:
    asked = {"coordinates": [q], "action": [u]}
    reply = httpx.post(f"{server.url}/v1/surrogates/{name}/predict", json=asked, timeout=60)
    made: dict[str, list[list[float]]] = reply.raise_for_status().json()
    return made


def test_a_surrogate_refuses_a_model_file_of_another_model_plugin(plugin_server: ServerProcess, taught: str):
    for name, model in (("mine", "bayesian_linear"), ("default", "gaussian_process")):
        body = {"name": name, "spec": designed(model).model_dump(mode="json")}
        httpx.post(f"{plugin_server.url}/v1/surrogates", json=body, timeout=60).raise_for_status()
    model = f"{plugin_server.url}/v1/surrogates/{taught}/models/1?format=safetensors"
    exported = httpx.get(model, timeout=60).raise_for_status().content
    octets = {"content-type": "application/octet-stream"}
    to = f"{plugin_server.url}/v1/surrogates/{{}}/models"
    assert httpx.post(to.format("mine"), content=exported, headers=octets, timeout=60).status_code == 201
    refused = httpx.post(to.format("default"), content=exported, headers=octets, timeout=60)
    assert refused.status_code == 422
    assert (
        "family 'gaussian_process', as the specification says, got one of 'bayesian_linear'" in refused.json()["detail"]
    )


@pytest.mark.parametrize(
    ("name", "settings", "said"),
    [
        (
            "nobody",
            {},
            "model: expected one of gaussian_process, ensemble, bayesian_linear, got 'nobody'",
        ),
        ("broken", {}, "package 'broken_model', entry point broken = 'nowhere_to_be_found:Missing' of surrogym.models"),
        ("bayesian_linear", {"depth": 1}, "expected a setting out of ridge, got 'depth'"),
        ("bayesian_linear", {"ridge": -1.0}, "expected a positive ridge, got -1.0"),
    ],
)
def test_missing_model_plugins_and_invalid_settings_are_refused(
    plugin_server: ServerProcess, name: str, settings: dict[str, float], said: str
):
    spec = designed(ModelChoice(name=name, settings=settings)).model_dump(mode="json")
    reply = httpx.post(f"{plugin_server.url}/v1/surrogates", json={"name": "refused", "spec": spec}, timeout=60)
    assert (reply.status_code, reply.json()["code"]) == (422, "invalid_spec")
    assert said in reply.json()["detail"]
    assert httpx.get(f"{plugin_server.url}/v1/surrogates/refused", timeout=60).status_code == 404


def test_the_server_starts_without_a_broken_model_plugin_and_logs_it(plugin_server: ServerProcess):
    assert "the model 'broken' is left out" in plugin_server.log
    assert "models: gaussian_process, ensemble, bayesian_linear" in plugin_server.log


@pytest.fixture(scope="module")
def cases(installed: Path) -> Iterator[dict[str, ModelCase]]:
    """The laws' environments, learned by the installed family in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(installed))
        patch.setattr(MODELS, "_installed", None)
        yield {case.name: case for case in model_cases("bayesian_linear")}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("law", LAWS_OF_MODELS, ids=lambda law: law.__name__)
def test_the_example_model_plugin_passes_the_model_interface_tests(cases: dict[str, ModelCase], law, name: str):
    law(cases[name])


def test_the_plugin_page_names_the_entry_point_of_the_example_model():
    page = (ROOT / "docs" / "how-to" / "plugins.md").read_text()
    assert 'bayesian_linear = "bayesian_linear:BayesianLinear"' in page
    assert 'bayesian_linear = "bayesian_linear:BayesianLinear"' in (EXAMPLE / "pyproject.toml").read_text()
