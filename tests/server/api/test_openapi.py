"""The documentation of the API: complete, and its examples work."""

from __future__ import annotations

from typing import Any

import httpx
import pytest

from surrogym_server.api import examples
from surrogym_shared import wire
from surrogym_shared.codes import PROBLEM_MEDIA_TYPE

EXAMPLES = {
    "CREATE": wire.CreateSurrogate,
    "PATCH": wire.PatchSurrogate,
    "CLAIM": wire.ClaimQueries,
    "RENEW": wire.RenewLease,
    "FAIL": wire.FailQuery,
    "ADD_QUERIES": wire.AddQueries,
    "WITHDRAW": wire.WithdrawQueries,
    "DROP_SNAPSHOTS": wire.DropSnapshots,
    "ADD_SAMPLE": wire.AddSamples,
    "DRAFT_LOG": wire.DraftLog,
    "ADD_LOG": wire.AddLog,
    "LEDGER": wire.ReportSteps,
    "IMPROVE": wire.Improve,
    "POINTS": wire.Points,
    "IMAGINE": wire.Imagine,
    "OPEN": wire.OpenSession,
    "RESET": wire.ResetSession,
    "STEP": wire.StepSession,
    "ROLLOUT": wire.RolloutSession,
    "OCCUPANCY": wire.SubmitOccupancy,
}


@pytest.fixture(scope="module")
def openapi(client: httpx.Client) -> dict[str, Any]:
    document: dict[str, Any] = client.get("/openapi.json").raise_for_status().json()
    return document


def operations(openapi: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    return [
        (f"{method.upper()} {path}", operation)
        for path, methods in openapi["paths"].items()
        for method, operation in methods.items()
    ]


def test_every_operation_has_an_id_of_its_own(openapi: dict[str, Any]):
    """Generators of clients name functions by it."""
    ids = [operation["operationId"] for _, operation in operations(openapi)]
    assert sorted(ids) == sorted(set(ids))


@pytest.mark.parametrize(("name", "model"), EXAMPLES.items())
def test_every_openapi_example_passes_validation(name: str, model: type[wire.Request]):
    model.model_validate(getattr(examples, name))


def test_every_defined_openapi_example_is_used_in_this_test():
    bodies = {name for name in vars(examples) if name.isupper()} - {"PENDULUM"}
    assert bodies == set(EXAMPLES)


def test_every_openapi_operation_has_a_summary_and_a_description(openapi: dict[str, Any]):
    for operation, said in operations(openapi):
        assert said["summary"], operation
        assert said["description"], operation


def test_every_openapi_request_body_has_an_example(openapi: dict[str, Any]):
    for operation, said in operations(openapi):
        for media_type, content in said.get("requestBody", {}).get("content", {}).items():
            if media_type == "application/json":
                assert "example" in content or "examples" in content, operation


def test_every_openapi_error_reply_has_the_problem_media_type(openapi: dict[str, Any]):
    assert "Problem" in openapi["components"]["schemas"]
    for operation, said in operations(openapi):
        for status, reply in said["responses"].items():
            if status >= "400":
                assert list(resolved(openapi, reply)["content"]) == [PROBLEM_MEDIA_TYPE], (operation, status)


def resolved(openapi: dict[str, Any], reply: dict[str, Any]) -> dict[str, Any]:
    name = reply.get("$ref", "").rpartition("/")[2]
    response: dict[str, Any] = openapi["components"]["responses"][name] if name else reply
    return response


def test_every_openapi_operation_lists_its_possible_error_statuses(openapi: dict[str, Any]):
    for operation, said in operations(openapi):
        guards = {"404", "405", "408", "413", "422", "429", "503"} | ({"401", "403"} if "security" in said else set())
        assert guards <= said["responses"].keys(), operation


def test_every_openapi_reference_points_to_a_defined_component(openapi: dict[str, Any]):
    def references(node: Any) -> set[str]:
        if isinstance(node, dict):
            below = set().union(*(references(value) for value in node.values())) if node else set()
            return below | ({node["$ref"]} if isinstance(node.get("$ref"), str) else set())
        return set().union(*(references(value) for value in node)) if isinstance(node, list) and node else set()

    known = {f"#/components/{kind}/{name}" for kind, parts in openapi["components"].items() for name in parts}
    assert references(openapi) <= known


def test_the_routes_reset_step_query_uncertainty_and_add_sample_keep_their_names(openapi: dict[str, Any]):
    for path in ("/v1/sessions/{id}/reset", "/v1/sessions/{id}/step"):
        assert path in openapi["paths"]
    for path in ("query_uncertainty", "add_sample"):
        assert f"/v1/surrogates/{{name}}/{path}" in openapi["paths"]
