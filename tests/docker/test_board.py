"""The board of Grafana and the settings of Prometheus ask for what the server has: its metrics and their labels."""

from __future__ import annotations

import json
import re
from collections import defaultdict
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml

from support.server import running_server
from support.teaching import teach
from surrogym_client.sb3 import SurrogateVecEnv
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum

DOCKER = Path(__file__).parents[2] / "docker"
BOARD: dict[str, Any] = json.loads((DOCKER / "grafana" / "boards" / "surrogym.json").read_text(encoding="utf-8"))
EXPRESSIONS = [target["expr"] for panel in BOARD["panels"] for target in panel["targets"]]
SELECTOR = re.compile(r"(surrogym_\w+)(?:\{([^}]*)\})?")


@pytest.fixture(scope="module")
def labels(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """Labels of each series of a server that has fitted and stepped."""
    with running_server(tmp_path_factory.mktemp("board")) as server, Api(server.url) as api:
        teach(api, "pendulum", pendulum(), queries=4)
        env = SurrogateVecEnv(server.url, "pendulum", num_envs=2)
        env.reset()
        env.close()
        text = httpx.get(f"{server.url}/metrics").text
    found: dict[str, set[str]] = defaultdict(set)
    for name, inside in re.findall(r"^(surrogym_\w+)(?:\{(.*)\})? ", text, re.MULTILINE):
        found[name] |= set(re.findall(r'(\w+)="', inside))
    return found


@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_every_grafana_panel_uses_existing_metrics_of_the_server(expression: str, labels: dict[str, set[str]]) -> None:
    selectors = SELECTOR.findall(expression)
    assert selectors
    for name, filters in selectors:
        assert name in labels, f"the server has no {name}"
        assert set(re.findall(r"(\w+)\s*(?:=~|!=|!~|=)", filters)) <= labels[name]
        for grouped in re.findall(r"by \(([^)]*)\)", expression):
            assert set(re.split(r",\s*", grouped)) <= labels[name]


def test_every_metric_of_the_server_is_on_the_grafana_dashboard(labels: dict[str, set[str]]) -> None:
    def family(name: str) -> str:
        return re.sub(r"_(bucket|sum|count|created)$", "", name)

    asked = {family(name) for expression in EXPRESSIONS for name, _ in SELECTOR.findall(expression)}
    assert {family(name) for name in labels} - asked == {"surrogym_build_info"}


def test_grafana_is_provisioned_with_data_source_and_dashboard() -> None:
    sources = yaml.safe_load((DOCKER / "grafana/provisioning/datasources/prometheus.yaml").read_text())["datasources"]
    assert {panel["datasource"]["uid"] for panel in BOARD["panels"]} == {source["uid"] for source in sources}
    (provider,) = yaml.safe_load((DOCKER / "grafana/provisioning/dashboards/boards.yaml").read_text())["providers"]
    mounts = yaml.safe_load((DOCKER / "compose.yaml").read_text())["services"]["grafana"]["volumes"]
    assert f"./grafana/boards:{provider['options']['path']}:ro" in mounts


def test_prometheus_scrapes_the_server_with_its_token() -> None:
    (job,) = yaml.safe_load((DOCKER / "prometheus.yaml").read_text())["scrape_configs"]
    assert job["static_configs"] == [{"targets": ["server:8000"]}]
    prometheus = yaml.safe_load((DOCKER / "compose.yaml").read_text())["services"]["prometheus"]
    assert '"$$SURROGYM_TOKEN" > /dev/shm/token' in prometheus["entrypoint"][2]
    assert prometheus["environment"]["SURROGYM_TOKEN"] == "${SURROGYM_TOKEN}"
    assert job["authorization"]["credentials_file"] == "/dev/shm/token"
