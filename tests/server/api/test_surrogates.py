"""The life of a surrogate: created, sampled, fitted, finished, improved, changed, deleted."""

from __future__ import annotations

import csv
import io
from typing import Any

import httpx
import numpy as np
import pytest

from support import pendulum
from support.noting import until
from surrogym_shared import wire


def view(client: httpx.Client, name: str) -> wire.SurrogateView:
    return wire.SurrogateView.model_validate_json(client.get(f"/v1/surrogates/{name}").raise_for_status().content)


def test_registering_the_same_surrogate_twice_changes_nothing(client: httpx.Client, fresh: str):
    first = client.get(f"/v1/surrogates/{fresh}").json()
    again = client.post("/v1/surrogates", json={"name": fresh, "spec": pendulum.spec()})
    assert (again.status_code, again.json()) == (201, {**first, "created": False})
    assert (first["phase"], first["queries"]["pending"]) == ("collecting", pendulum.INITIAL)


def test_checking_a_registration_stores_nothing(client: httpx.Client, name: str):
    checked = client.post("/v1/surrogates:check", json={"name": name, "spec": pendulum.spec()})
    assert checked.status_code == 200
    assert (checked.json()["initial"], checked.json()["exists"]) == (pendulum.INITIAL, False)
    assert client.get(f"/v1/surrogates/{name}").status_code == 404
    created = client.post("/v1/surrogates", json={"name": name, "spec": pendulum.spec()}).json()
    same = ("spec", "budget", "target", "outputs")
    assert {key: created[key] for key in same} == {key: checked.json()[key] for key in same}
    again = client.post("/v1/surrogates:check", json={"name": name, "spec": pendulum.spec()}).json()
    assert again["exists"]
    other = client.post("/v1/surrogates:check", json={"name": name, "spec": pendulum.spec(initial=7)})
    assert (other.status_code, other.json()["code"]) == (409, "spec_conflict")
    client.delete(f"/v1/surrogates/{name}")


def test_the_first_queries_of_a_new_surrogate_form_a_latin_hypercube(client: httpx.Client, fresh: str):
    queries = client.get(f"/v1/surrogates/{fresh}/queries").json()["queries"]
    speeds = sorted((query["coordinates"][1] + 8) / 16 * pendulum.INITIAL for query in queries)
    assert [int(speed) for speed in speeds] == list(range(pendulum.INITIAL))
    assert {query["purpose"] for query in queries} == {"initial"}


def test_the_design_uses_its_whole_budget_and_the_ledger_counts_it(client: httpx.Client, taught: str):
    finished = view(client, taught)
    assert finished.phase == "over_budget"
    assert finished.ledger.initial == pendulum.INITIAL
    assert finished.ledger.adaptive == pendulum.BUDGET - pendulum.INITIAL
    assert finished.ledger.total == finished.samples == pendulum.BUDGET
    assert finished.fidelity is not None
    assert [output.name for output in finished.fidelity.outputs] == finished.outputs
    assert finished.outputs == ["theta", "theta_dot", "reward"]


def test_the_surrogate_list_contains_confidence_index_and_model_version(client: httpx.Client, taught: str):
    listed = {summary["name"]: summary for summary in client.get("/v1/surrogates").json()["surrogates"]}
    finished = view(client, taught)
    assert listed[taught]["confidence_index"] == finished.confidence_index
    assert listed[taught]["model_version"] == finished.model_version


def test_the_surrogate_list_can_be_read_in_pages(client: httpx.Client, taught: str, fresh: str):
    whole = client.get("/v1/surrogates").json()
    assert whole.keys() == {"surrogates"}, "as clients know it that follow no pages"
    listed: list[str] = []
    after: int | None = 0
    while after is not None:
        page = client.get("/v1/surrogates", params={"limit": 1, "after": after}).json()
        assert len(page["surrogates"]) == 1
        listed, after = [*listed, page["surrogates"][0]["name"]], page.get("next_after")
    assert listed == [summary["name"] for summary in whole["surrogates"]]
    assert {taught, fresh} <= set(listed)
    for wrong in ({"limit": 0}, {"limit": 1_001}, {"after": -1}, {"after": "pendulum"}):
        refused = client.get("/v1/surrogates", params=wrong)
        assert (refused.status_code, refused.json()["code"]) == (422, "invalid_request")


def test_a_repeated_improve_request_adds_queries_and_raises_the_budget_once(client: httpx.Client, name: str):
    before = pendulum.teach(client, name, budget=5)
    body = {"queries": 2, "idempotency_key": "once"}
    for _ in range(2):
        improved = client.post(f"/v1/surrogates/{name}/improve", json=body).raise_for_status().json()
        assert (improved["budget"], improved["budget_raised_by"], improved["budget_left"]) == (7, 2, 0)
    after = pendulum.finish(client, name)
    assert (before["samples"], after["samples"], after["budget"]) == (5, 7, 7)


def test_an_improve_request_accepts_the_states_that_a_policy_visited(client: httpx.Client, name: str):
    pendulum.teach(client, name, budget=5)
    opened = client.post(f"/v1/surrogates/{name}/sessions", json={"num_envs": 4, "occupancy": True}).json()
    for what, body in (("reset", {}), ("step", {"action": [[0.0]] * 4})):
        client.post(f"/v1/sessions/{opened['id']}/{what}", json=body).raise_for_status()
    submitted = client.post(f"/v1/sessions/{opened['id']}/occupancy", json={"checkpoint": "first"}).json()
    assert (submitted["checkpoint"], submitted["states"]) == ("first", 8)
    assert 0.5 <= submitted["confidence_index"] <= 1
    body = {"queries": 1, "checkpoint": "first"}
    client.post(f"/v1/surrogates/{name}/improve", json=body).raise_for_status()
    assert pendulum.finish(client, name)["samples"] == 6


def test_raising_the_budget_restarts_a_finished_design(client: httpx.Client, name: str):
    pendulum.teach(client, name, budget=5)
    client.patch(f"/v1/surrogates/{name}", json={"budget": 7}).raise_for_status()
    assert pendulum.finish(client, name)["samples"] == 7


def test_after_a_change_of_tolerance_the_server_judges_a_finished_design_again(client: httpx.Client, name: str):
    pendulum.teach(client, name, budget=5)
    changed = client.patch(f"/v1/surrogates/{name}", json={"tolerances": {"theta_dot": 0.25}, "budget": 6})
    assert changed.raise_for_status().json()["tolerances"] == {"theta_dot": 0.25}
    judged = pendulum.finish(client, name)["fidelity"]["outputs"]
    assert next(output for output in judged if output["name"] == "theta_dot")["tolerance"] == 0.25
    for refused, words in (
        ({"cos": 0.1}, "'cos'"),
        ({"theta_dot": 0}, "greater than 0"),
        ({"theta_dot": "1"}, "number"),
    ):
        problem = client.patch(f"/v1/surrogates/{name}", json={"tolerances": refused})
        assert problem.status_code == 422
        assert words in problem.text
    assert view(client, name).tolerances == {"theta_dot": 0.25}
    back = client.patch(f"/v1/surrogates/{name}", json={"tolerances": {"theta_dot": None}})
    assert back.raise_for_status().json()["tolerances"] == {}
    judged = pendulum.finish(client, name)["fidelity"]["outputs"]
    assert next(output for output in judged if output["name"] == "theta_dot")["tolerance"] != 0.25


def test_correcting_a_wrong_tolerance_withdraws_the_queries_it_caused(client: httpx.Client, name: str):
    """What it made the design ask is withdrawn with it, though nobody answers it."""
    taken = pendulum.teach(client, name, budget=9)["ledger"]["total"]
    for value, waiting in ((1e-12, True), (10.0, False)):
        body = {"tolerances": dict.fromkeys(("theta", "theta_dot", "reward"), value), "budget": 12}
        client.patch(f"/v1/surrogates/{name}", json=body).raise_for_status()
        assert until(lambda: tolerance_of_theta(client, name) == value)  # noqa: B023
        assert (view(client, name).queries.pending > 0) == waiting
    after = view(client, name)
    assert (after.phase, after.ledger.total) == ("ready", taken)


def tolerance_of_theta(client: httpx.Client, name: str) -> float:
    fidelity = view(client, name).fidelity
    assert fidelity is not None
    return next(output.tolerance for output in fidelity.outputs if output.name == "theta")


def test_a_paused_design_hands_out_no_queries(client: httpx.Client, fresh: str):
    assert client.patch(f"/v1/surrogates/{fresh}", json={"paused": True}).json()["paused"]
    claimed = pendulum.claim(client, fresh, wait_seconds=0)
    assert (claimed["queries"], claimed["paused"]) == ([], True)
    client.patch(f"/v1/surrogates/{fresh}", json={"paused": False}).raise_for_status()
    assert pendulum.claim(client, fresh, wait_seconds=0)["queries"]


def test_the_design_finishes_without_answers_to_failed_queries(client: httpx.Client, fresh: str):
    lost = client.get(f"/v1/surrogates/{fresh}/queries").json()["queries"][0]["id"]
    while (found := view(client, fresh)).phase != "unsure":
        assert found.phase != "failed", found.error
        for query in pendulum.claim(client, fresh)["queries"]:
            if query["id"] == lost:
                body = {"lease_token": query["lease_token"], "error": "the motor did not answer"}
                client.post(f"/v1/surrogates/{fresh}/queries/{lost}:fail", json=body).raise_for_status()
            else:
                pendulum.add(client, fresh, [pendulum.answer(query)]).raise_for_status()
    assert (found.queries.set_aside, found.samples) == (1, pendulum.BUDGET - 1), "it counts against the budget"
    aside = client.get(f"/v1/surrogates/{fresh}/queries?status=set_aside").json()["queries"]
    assert [query["error"] for query in aside] == ["the motor did not answer"]


def test_a_design_whose_initial_queries_all_failed_continues_after_manual_samples(client: httpx.Client, fresh: str):
    while view(client, fresh).phase == "collecting":
        for query in pendulum.claim(client, fresh)["queries"]:
            body = {"lease_token": query["lease_token"], "error": "no power"}
            path = f"/v1/surrogates/{fresh}/queries/{query['id']}:fail"
            client.post(path, json=body).raise_for_status()
    failed = view(client, fresh)
    assert (failed.phase, failed.error) == (
        "failed",
        f"all {pendulum.INITIAL} initial queries were set aside; the last error was: no power",
    )
    samples = [pendulum.real_step([x, 2 * x], [x / 2]) for x in np.linspace(-3, 3, pendulum.BUDGET)]
    pendulum.add(client, fresh, samples, idempotency_key="by hand").raise_for_status()
    while (found := view(client, fresh)).phase != "over_budget":
        pendulum.claim(client, fresh, wait_seconds=0.2)
    assert (found.ledger.manual, found.error, found.model_version) == (pendulum.BUDGET, None, 1)


def test_the_lease_of_a_query_can_be_renewed(client: httpx.Client, fresh: str):
    query = pendulum.claim(client, fresh, max_queries=1, lease_seconds=60)["queries"][0]
    body = {"lease_token": query["lease_token"], "lease_seconds": 30}
    assert client.post(f"/v1/surrogates/{fresh}/queries/{query['id']}:renew", json=body).status_code == 204


def test_a_query_whose_lease_expired_goes_to_the_next_sampler(client: httpx.Client, fresh: str):
    first = pendulum.claim(client, fresh, lease_seconds=0.05)["queries"]
    second = pendulum.claim(client, fresh, sampler="next")["queries"]
    assert {query["id"] for query in second} <= {query["id"] for query in first}
    assert second[0]["attempt"] == 2
    late = pendulum.add(client, fresh, [pendulum.answer(first[0])]).raise_for_status().json()
    kept = client.get(f"/v1/surrogates/{fresh}/samples").json()["samples"]
    assert [(sample["id"], sample["late"]) for sample in kept] == [(late["sample_ids"][0], True)]


def test_manual_queries_of_a_finished_design_are_handed_out_and_answered(client: httpx.Client, name: str):
    pendulum.teach(client, name, budget=5)
    body = {"coordinates": [[1.0, 0.5]], "action": [[0.25]], "idempotency_key": "once"}
    asked = [client.post(f"/v1/surrogates/{name}/queries", json=body).json()["queries"] for _ in range(2)]
    assert asked[0] == asked[1]
    after = pendulum.finish(client, name)
    assert (after["ledger"]["manual"], after["samples"]) == (1, 6)


def test_the_ledger_counts_a_repeated_evaluation_report_once(client: httpx.Client, fresh: str):
    body = {"steps": 200, "episodes": 1, "idempotency_key": "e"}
    counts = [client.post(f"/v1/surrogates/{fresh}/ledger", json=body).json() for _ in range(2)]
    assert counts[0] == counts[1]
    assert (counts[0]["evaluation"], counts[0]["total"]) == (200, 0)


def test_samples_can_be_read_in_pages_as_csv_and_as_npz(client: httpx.Client, taught: str):
    path = f"/v1/surrogates/{taught}/samples"
    after: int | None = 0
    samples: list[dict[str, Any]] = []
    while after is not None:
        page = client.get(path, params={"limit": 3, "after": after}).json()
        samples, after = samples + page["samples"], page["next_after"]
    assert len(samples) == pendulum.BUDGET
    rows = list(csv.DictReader(io.StringIO(client.get(path, params={"format": "csv"}).text)))
    assert [float(row["q.theta_dot"]) for row in rows] == [sample["coordinates"][1] for sample in samples]
    assert [float(row["u.0"]) for row in rows] == [sample["action"][0] for sample in samples]
    with np.load(io.BytesIO(client.get(path, params={"format": "npz"}).content), allow_pickle=False) as file:
        np.testing.assert_array_equal(file["next_coordinates"], [s["next_coordinates"] for s in samples])
        assert file["coordinate_names"].tolist() == ["theta", "theta_dot"]


def test_an_exported_model_predicts_the_same_after_import(client: httpx.Client, taught: str, fresh: str):
    models = client.get(f"/v1/surrogates/{taught}/models").json()["models"]
    latest = len(models)
    assert latest >= 2
    assert [model["version"] for model in models] == list(range(1, latest + 1))
    assert client.get(f"/v1/surrogates/{taught}/models/2").json() == models[1]
    export = client.get(f"/v1/surrogates/{taught}/models/{latest}", params={"format": "safetensors"}).content
    imported = (
        client.post(
            f"/v1/surrogates/{fresh}/models", content=export, headers={"content-type": "application/octet-stream"}
        )
        .raise_for_status()
        .json()
    )
    assert (imported["version"], imported["data_hash"]) == (1, models[-1]["data_hash"])
    points = {"coordinates": [[0.3, -1.0]], "action": [[0.7]]}
    said = [client.post(f"/v1/surrogates/{name}/predict", json=points).json() for name in (taught, fresh)]
    assert said[0] | {"model_version": 1} == said[1]
    again = client.get(f"/v1/surrogates/{fresh}/models/1", params={"format": "safetensors"}).content
    assert again == export


def test_predictions_fit_the_samples_and_are_uncertain_far_from_them(client: httpx.Client, taught: str):
    known = client.get(f"/v1/surrogates/{taught}/samples").json()["samples"][0]
    points = {"coordinates": [known["coordinates"], [1.0, 7.0]], "action": [known["action"], [2.0]]}
    said = wire.Prediction(**client.post(f"/v1/surrogates/{taught}/predict", json=points).json())
    assert said.reward[0] == pytest.approx(known["reward"], abs=1e-2)
    unsure = wire.Uncertainty(**client.post(f"/v1/surrogates/{taught}/query_uncertainty", json=points).json())
    assert unsure.deviation[0][2] < unsure.deviation[1][2], "it knows best what it has seen"
    np.testing.assert_allclose(unsure.uncertainty_index, np.exp(unsure.log_uncertainty_index))


def test_deleting_a_surrogate_also_deletes_its_sessions_and_models(client: httpx.Client, name: str):
    pendulum.teach(client, name, budget=5)
    session = client.post(f"/v1/surrogates/{name}/sessions", json={}).json()["id"]
    assert client.delete(f"/v1/surrogates/{name}").status_code == 204
    assert client.get(f"/v1/surrogates/{name}").status_code == 404
    assert client.post(f"/v1/sessions/{session}/reset", json={}).status_code == 404
    client.post("/v1/surrogates", json={"name": name, "spec": pendulum.spec()}).raise_for_status()
    assert view(client, name).model_version is None


def test_a_surrogate_lists_its_samplers_and_has_no_sessions_at_first(client: httpx.Client, fresh: str):
    before = view(client, fresh)
    query = pendulum.claim(client, fresh, max_queries=1)["queries"][0]
    pendulum.add(client, fresh, [pendulum.answer(query)]).raise_for_status()
    assert (before.samplers, len(view(client, fresh).samplers)) == ([], 1)
    assert before.sessions == 0


def test_a_surrogate_counts_its_open_sessions(client: httpx.Client, taught: str, session: str):
    assert view(client, taught).sessions >= 1
