"""The OpenAPI is complete enough that a client generated from it runs the whole loop, typed, against a live server."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import httpx
import pytest

from support import pendulum
from support.server import ServerProcess
from surrogym_sampler.original.classic import pendulum as pendulum_spec
from surrogym_sampler.original.gymnasium import GymnasiumEnvironment

PACKAGE = "generated_surrogym_client"
FRAMES = "Unsupported content type application/vnd.msgpack"  # beside JSON; no generator knows the frames
QUERIES = 4
Call = Callable[..., Any]


@pytest.fixture(scope="module")
def generated(client: httpx.Client, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """What the generator said; its package can be imported meanwhile."""
    folder = tmp_path_factory.mktemp("generated")
    (folder / "openapi.json").write_bytes(client.get("/openapi.json").raise_for_status().content)
    (folder / "config.json").write_text(json.dumps({"post_hooks": []}))
    options = ["--path", "openapi.json", "--output-path", PACKAGE, "--meta", "none", "--config", "config.json"]
    command = [sys.executable, "-m", "openapi_python_client", "generate", *options]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    sys.path.insert(0, str(folder))
    yield done.stdout + done.stderr
    sys.path.remove(str(folder))
    for name in [name for name in sys.modules if name.partition(".")[0] == PACKAGE]:
        del sys.modules[name]


def module(path: str) -> ModuleType:
    return importlib.import_module(f"{PACKAGE}.{path}")


def test_a_client_generated_from_openapi_has_every_operation_except_binary_frames(generated: str, client: httpx.Client):
    reasons = generated.count("WARNING parsing")
    assert generated.count(FRAMES) == reasons == 3  # reset, step, rollout
    assert "Unable to process" not in generated
    folder = Path(module("api").__file__ or "").parent
    functions = [path.stem for path in folder.rglob("*.py") if path.stem != "__init__"]
    operations = [o for methods in client.get("/openapi.json").json()["paths"].values() for o in methods.values()]
    assert sorted(functions) == sorted(o["operationId"] for o in operations)


@pytest.fixture
def call(generated: str, server_process: ServerProcess) -> Iterator[Call]:
    """Calls an operation by its name; gives its reply, typed."""
    with module("client").Client(base_url=server_process.url, timeout=httpx.Timeout(60)) as talker:

        def call_one(operation: str, *arguments: Any, **options: Any) -> Any:
            room = operation.partition("_")[0]
            return module(f"api.{room}.{operation}").sync(*arguments, client=talker, **options)

        yield call_one


def test_a_client_generated_from_openapi_can_register_sample_and_step(call: Call, name: str):
    models = module("models")
    spec = models.EnvironmentSpec.from_dict(pendulum.spec() | {"design": {"initial": QUERIES, "budget": QUERIES}})
    created = call("surrogates_create", body=models.CreateSurrogate(name=name, spec=spec))
    assert isinstance(created, models.CreatedSurrogate)
    assert created.spec.time_limit == spec.time_limit
    original, answered, phase = GymnasiumEnvironment(pendulum_spec()), 0, ""
    while phase not in ("ready", "over_budget"):
        claim = models.ClaimQueries(sampler="generated", max_queries=QUERIES, wait_seconds=1.0)
        claimed = call("queries_claim", name, body=claim)
        phase = claimed.phase
        for query in claimed.queries:
            assert isinstance(query, models.StepQuery)
            step = original.step_from(query.coordinates, query.action)
            sample = models.NewSample(
                query_id=query.id,
                lease_token=query.lease_token,
                coordinates=list(step.coordinates),
                action=list(step.action),
                next_coordinates=list(step.next_coordinates),
                reward=step.reward,
                terminated=step.terminated,
            )
            added = call("samples_add_sample", name, body=models.AddSamples(sampler="generated", samples=[sample]))
            answered += len(added.sample_ids)
    assert answered == QUERIES
    assert call("surrogates_get", name).fidelity.samples == QUERIES
    session = call("sessions_open_session", name, body=models.OpenSession(num_envs=2, seed=0))
    assert isinstance(session.action_space, models.BoxSpace)
    start = call("sessions_reset", session.id, body=models.SessionsResetJsonResetSession())
    stepped = call("sessions_step", session.id, body=models.SessionsStepJsonStepSession(action=[[0.5], [-0.5]]))
    assert (len(start.observation), len(stepped.reward), stepped.terminated) == (2, 2, [False, False])
    refused = call("surrogates_get", "nobody")
    assert isinstance(refused, models.Problem)
    assert refused.code == "unknown_surrogate"
