"""Requests are named and timed, and the figures of ``/metrics`` are those of what happened."""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from support import pendulum
from support.server import running_server
from surrogym_client.errors import error_from_problem
from surrogym_shared.codes import Problem


def read(client: httpx.Client) -> dict[tuple[str, tuple[str, ...]], float]:
    """Value of each series: (name, label values in the order of their names)."""
    text = client.get("/metrics").raise_for_status().text
    return {
        (sample.name, tuple(value for _, value in sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_metrics_show_real_steps_queries_phase_and_model_of_a_surrogate(client: httpx.Client, taught: str):
    shown = read(client)
    adaptive = pendulum.BUDGET - pendulum.INITIAL
    assert shown["surrogym_real_steps_total", ("initial", taught)] == pendulum.INITIAL
    assert shown["surrogym_real_steps_total", ("adaptive", taught)] == adaptive
    assert shown["surrogym_queries", ("answered", taught)] == pendulum.BUDGET
    assert shown["surrogym_phase", ("over_budget", taught)] == 1
    model = client.get(f"/v1/surrogates/{taught}").json()
    assert shown["surrogym_model_version", (taught,)] == model["model_version"]
    assert shown["surrogym_confidence_index", (taught,)] == model["confidence_index"]


def test_metrics_count_virtual_steps_and_parallel_environments(
    client: httpx.Client, open_session: Callable[..., dict[str, Any]]
):
    id = open_session(num_envs=3)["id"]
    client.post(f"/v1/sessions/{id}/reset", json={}).raise_for_status()
    before = read(client)
    for _ in range(4):
        client.post(f"/v1/sessions/{id}/step", json={"action": [0.0] * 3}).raise_for_status()
    after = read(client)

    def grown(name: str, *labels: str) -> float:
        return after[name, labels] - before.get((name, labels), 0.0)

    assert grown("surrogym_lane_steps_total") == 12
    assert grown("surrogym_step_seconds_count") == 4
    assert grown("surrogym_request_seconds_count", "POST", "/v1/sessions/{id}/step", "200") == 4
    assert before["surrogym_lanes", ()] >= 3


def test_metrics_show_the_number_of_waiting_session_requests(
    client: httpx.Client, open_session: Callable[..., dict[str, Any]]
):
    id = open_session(num_envs=1)["id"]
    client.post(f"/v1/sessions/{id}/reset", json={}).raise_for_status()
    body = {"actions": [[0.0]] * 5_000}
    seen = 0.0
    with ThreadPoolExecutor(1) as pool:
        for _ in range(20):  # on a busy machine one rollout may end before the metrics are read
            rollout = pool.submit(client.post, f"/v1/sessions/{id}/rollout", json=body)
            while not rollout.done() and not seen:
                seen = read(client)["surrogym_session_requests", ()]
            rollout.result().raise_for_status()
            if seen:
                break
    assert seen >= 1
    assert read(client)["surrogym_session_requests", ()] == 0


def test_a_reply_carries_the_request_id_of_the_caller_or_a_new_one(client: httpx.Client):
    assert client.get("/healthz", headers={"x-request-id": "mine-1"}).headers["x-request-id"] == "mine-1"
    new = [client.get("/healthz", headers={"x-request-id": given}).headers["x-request-id"] for given in ("a b", "")]
    assert len({"a b", "", *new}) == 4


def test_an_error_reply_carries_its_request_id_and_the_client_prints_it(client: httpx.Client):
    reply = client.get("/v1/surrogates/nowhere")
    problem = Problem.model_validate_json(reply.content)
    assert problem.request == reply.headers["x-request-id"]
    assert str(error_from_problem(problem)).endswith(f"[request {problem.request}]")


def test_a_refused_stream_is_logged_as_a_request_and_not_as_an_error(tmp_path: Path):
    """Of another site's page, without a session: each is told why, and what the log says of it is that."""
    with running_server(tmp_path) as server:
        address = f"{server.url.replace('http', 'ws', 1)}/v1/sessions/nowhere/stream"
        with pytest.raises(InvalidStatus) as foreign:
            connect(address, origin=Origin("https://elsewhere.example"))
        with pytest.raises(InvalidStatus) as missing:
            connect(address)
        counted = httpx.get(f"{server.url}/metrics").text
        server.stop()
    assert [said.value.response.status_code for said in (foreign, missing)] == [403, 404]
    for status, route in ((403, "unknown"), (404, "/v1/sessions/{id}/stream")):
        assert f"GET /v1/sessions/nowhere/stream -> {status} in" in server.log
        assert f'{{method="GET",route="{route}",status="{status}"}} 1.0' in counted
    assert "ERROR" not in server.log


def test_server_logs_in_json_format_carry_the_request_id(tmp_path: Path):
    with running_server(tmp_path, "--log-format", "json") as server:
        httpx.get(f"{server.url}/v1/surrogates/nowhere", headers={"x-request-id": "find-me"})
        server.stop()
    lines = [line for line in server.log.splitlines() if not line.startswith("Surrogym listens")]
    records = [json.loads(line) for line in lines]
    found = [record for record in records if record.get("request") == "find-me"]
    assert [record["level"] for record in found] == ["info"]
    assert "GET /v1/surrogates/nowhere -> 404" in found[0]["message"]
