"""Acquisitions of other packages: installed, found by name, asked over HTTP; a broken one is one sentence."""

from __future__ import annotations

from pathlib import Path

import httpx
import numpy as np
import pytest

from support.server import ServerProcess
from support.teaching import teach
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum
from surrogym_shared.spec import AcquisitionChoice as Choice
from surrogym_shared.spec import Design

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "plugins" / "acquisition"
BROKEN = "broken_acquisition"


def designed(settings: dict[str, float | str]) -> Design:
    return Design(acquisition=Choice(name="focused_variance", settings=settings), target=0.99999)


def test_the_design_uses_an_installed_acquisition_plugin(plugin_server: ServerProcess):
    """Near a speed of 6, as its settings say; the ranges are -8 to 8."""
    settings = {"coordinate": "speed", "near": 6.0, "width": 0.5}
    spec = pendulum().model_copy(update={"design": designed(settings)})
    with Api(plugin_server.url) as api:
        teach(api, "focused", spec, queries=12, initial=4)
        speeds = np.array([sample.coordinates[1] for sample in api.samples("focused") if sample.purpose == "adaptive"])
    assert len(speeds) >= 1
    assert np.abs(speeds - 6.0).max() < 2.0


@pytest.mark.parametrize(
    ("name", "settings", "said"),
    [
        (
            "nobody",
            {},
            "expected one of integrated_variance, variance, uncertainty_index, latin_hypercube, ",
        ),
        ("broken", {}, f"package '{BROKEN}', entry point broken = 'nowhere_to_be_found:Missing'"),
        ("focused_variance", {"sigma": 1.0}, "expected a setting out of coordinate, near, width, got 'sigma'"),
        (
            "focused_variance",
            {},
            "acquisition focused_variance: expected a value for coordinate, which has no default, got none; "
            "all settings are coordinate, near, width",
        ),
        (
            "focused_variance",
            {"coordinate": "speed", "width": "abc"},
            "acquisition focused_variance: expected width to be a number, got 'abc'",
        ),
        (
            "focused_variance",
            {"coordinate": "x"},
            "acquisition focused_variance: expected coordinate to be one of theta, speed, got 'x'",
        ),
        ("focused_variance", {"coordinate": "speed", "width": -1.0}, "expected a positive width, got -1.0"),
        ("variance", {"width": 1.0}, "expected no settings, got 'width'"),
    ],
)
def test_missing_acquisition_plugins_and_invalid_settings_are_refused(
    plugin_server: ServerProcess, name: str, settings: dict[str, object], said: str
):
    spec = pendulum().model_dump(mode="json")
    spec["design"]["acquisition"] = {"name": name, "settings": settings}
    reply = httpx.post(f"{plugin_server.url}/v1/surrogates", json={"name": "refused", "spec": spec}, timeout=60)
    assert (reply.status_code, reply.json()["code"]) == (422, "invalid_spec")
    assert said in reply.json()["detail"]
    assert httpx.get(f"{plugin_server.url}/v1/surrogates/refused", timeout=60).status_code == 404


def test_the_server_starts_without_a_broken_acquisition_plugin_and_logs_it(plugin_server: ServerProcess):
    assert "the acquisition 'broken' is left out" in plugin_server.log
    assert "No module named 'nowhere_to_be_found'" in plugin_server.log
    assert "focused_variance" in plugin_server.log


def test_the_plugin_page_shows_the_code_of_the_example_acquisition():
    """Every line of the page's class stands in the package's module."""
    page = (ROOT / "docs" / "how-to" / "plugins.md").read_text()
    shown = page.partition("```python\n")[2].partition("```")[0]
    module = (EXAMPLE / "focused_variance.py").read_text()
    assert [line for line in shown.splitlines() if line not in module.splitlines()] == []
    assert 'focused_variance = "focused_variance:FocusedVariance"' in (EXAMPLE / "pyproject.toml").read_text()
