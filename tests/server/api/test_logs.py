"""Logs by HTTP: each row is judged, nothing is stored by a check, and the bounds hold."""

from __future__ import annotations

import httpx
import numpy as np
import pytest

from support import pendulum, reactor
from surrogym_sampler.logs import read_log
from surrogym_sampler.original.classic import pendulum as original
from surrogym_sampler.original.gymnasium import GymnasiumEnvironment

HEADING = "theta,theta_dot,action_torque,reward,episode"


def log(rows: int, spoiled: str = "") -> str:
    """Steps of one episode of Pendulum as CSV; ``spoiled`` is one more row."""
    machine, q = GymnasiumEnvironment(original()), np.array([0.1, 0.0])
    lines = [HEADING]
    for number in range(rows):
        action = np.array([np.sin(number)])
        step = machine.step_from(q, action)
        lines.append(f"{q[0]!r},{q[1]!r},{action[0]!r},{step.reward!r},0".replace("np.float64(", "").replace(")", ""))
        q = np.asarray(step.next_coordinates)
    return "\n".join([*lines, spoiled, ""] if spoiled else [*lines, ""])


def test_checking_a_log_lists_unusable_rows_and_stores_nothing(client: httpx.Client, fresh: str):
    body = {"text": log(20, "0.1,9.5,0.0,-1,1"), "check_only": True}
    report = client.post(f"/v1/surrogates/{fresh}/logs", json=body).raise_for_status().json()
    assert (report["rows"], report["steps"], report["rejected"], report["stored"]) == (21, 19, 1, 0)
    assert report["rejected_rows"] == [{"line": 22, "reason": "theta_dot: expected a value in [-8, 8], got 9.5"}]
    assert report["columns"]["action_torque"] == "action torque"
    assert client.get(f"/v1/surrogates/{fresh}").json()["ledger"]["logged"] == 0


def test_an_imported_log_costs_no_budget_and_is_stored_once(client: httpx.Client, fresh: str):
    url = f"/v1/surrogates/{fresh}/logs"
    text = log(20)
    first, again = (client.post(url, json={"text": text}).raise_for_status().json() for _ in range(2))
    assert (first["stored"], first["duplicates"]) == (19, 0)
    assert (again["stored"], again["duplicates"]) == (0, 19)
    ledger = client.get(f"/v1/surrogates/{fresh}").json()["ledger"]
    assert (ledger["logged"], ledger["total"]) == (19, 0)


def test_a_column_mapping_imports_a_log_with_other_column_names(client: httpx.Client, fresh: str):
    text = log(5).replace(HEADING, "angle,rate,motor,profit,batch")
    url = f"/v1/surrogates/{fresh}/logs"
    refused = client.post(url, json={"text": text, "check_only": True})
    assert (refused.status_code, refused.json()["code"]) == (422, "invalid_request")
    mapping = {
        "state": {"theta": "angle", "theta_dot": "rate"},
        "action": ["motor"],
        "reward": "profit",
        "episode": "batch",
    }
    report = client.post(url, json={"text": text, "mapping": mapping, "check_only": True}).raise_for_status().json()
    assert report["steps"] == 4
    assert report["mapping"]["state"] == mapping["state"]


def test_a_specification_drafted_over_http_equals_that_of_the_command(client: httpx.Client, tmp_path):
    file = reactor.log(runs=3, length=20).write(tmp_path / "reactor.csv")
    own = read_log(file)
    body = {"text": file.read_text(), "environment": "reactor"}
    drafted = client.post("/v1/logs:draft", json=body).raise_for_status().json()
    assert drafted["spec"] == own.spec.model_dump(mode="json")
    assert (drafted["notes"], drafted["steps"]) == (list(own.notes), len(own.steps))


@pytest.mark.parametrize(
    ("body", "status", "expected"),
    [
        ({"text": "theta\n"}, 422, "row below the heading"),
        ({"text": log(3), "mapping": {"state": {"theta": "x"}, "action": ["y"]}}, 422, "names the column 'x'"),
        ({"text": log(3), "mapping": {"state": {}, "run": "os.system"}}, 422, "mapping"),
        ({"text": log(3), "file": "/etc/passwd"}, 422, "file"),
        ({"text": HEADING + "\n" + "0,0,0,0,0\n" * 50_001}, 422, "at most 50,000 rows"),
        ({"text": "x" * 6 * 1024 * 1024}, 413, "at most 5242880 bytes"),
    ],
)
def test_an_invalid_log_is_refused_with_the_expected_format(
    client: httpx.Client, fresh: str, body: dict[str, object], status: int, expected: str
):
    refused = client.post(f"/v1/surrogates/{fresh}/logs", json=body)
    assert refused.status_code == status
    assert expected in refused.json()["detail"]
    assert client.get(f"/v1/surrogates/{fresh}").json()["samples"] == 0
    assert client.get(f"/v1/surrogates/{fresh}").json()["queries"]["pending"] == pendulum.INITIAL


@pytest.mark.parametrize(
    ("first", "last", "says"),
    [("1e13", "3e13", "at most 1e+12 in size"), ("1e-300", "3e-300", "differ by 1e-12 or more")],
)
def test_drafting_from_a_log_with_extreme_numbers_is_refused_as_invalid_request(
    client: httpx.Client, first: str, last: str, says: str
):
    refused = client.post("/v1/logs:draft", json={"text": f"x,action_a\n{first},1.5\n{last},2\n{first},3\n"})
    assert (refused.status_code, refused.json()["code"]) == (422, "invalid_request")
    assert says in refused.json()["detail"]


def test_a_log_column_named_cls_becomes_a_coordinate(client: httpx.Client):
    drafted = client.post("/v1/logs:draft", json={"text": "cls,action_a\n1,1.5\n2,2\n4,3\n"})
    assert drafted.raise_for_status().json()["spec"]["coordinates"][0]["name"] == "cls"
