"""A surrogate outlives the package of its family of models or its acquisition: all that is stored can be read."""

from __future__ import annotations

import asyncio
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import httpx
import pytest
from typer.testing import CliRunner, Result

from support import pendulum
from support.searched import searching, with_path, write_package
from support.server import ServerProcess, running_server
from surrogym.cli import build
from surrogym_client.transport import Api
from surrogym_server.convert import definition_from_spec
from surrogym_server.engine.design_job import DesignJob, DesignResult, run_design_job
from surrogym_server.engine.models import ModelCache
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.design import initial_queries
from surrogym_server.services.definitions import Definitions
from surrogym_server.services.designer import Designer, DesignerSettings
from surrogym_server.services.metrics import ProcessMetrics
from surrogym_server.services.models import load_model
from surrogym_server.services.notices import Notices
from surrogym_server.storage import records
from surrogym_server.storage.sql import Storage, open_storage
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import NewSample

EXAMPLES = Path(__file__).parents[2] / "examples" / "plugins"
DESIGNS = {
    "lin": {"model": {"name": "bayesian_linear"}},
    "foc": {"acquisition": {"name": "focused_variance", "settings": {"coordinate": "theta"}}},
}
TARGET = 0.99999
INSTALL = "which no installed package provides: install its package on the server and restart"
LIN = f"surrogate lin needs the model family 'bayesian_linear', {INSTALL}"
FOC = f"surrogate foc needs the acquisition 'focused_variance', {INSTALL}"


class Here:
    """Fits in this process, which has the packages while it is ``searching``."""

    async def run(self, job: DesignJob) -> DesignResult:
        return run_design_job(job)


def define(spec: dict[str, object]) -> EnvironmentDefinition:
    return definition_from_spec(EnvironmentSpec.model_validate(spec))


def teach(storage: Storage, name: str, spec: dict[str, object]) -> None:
    """Register a surrogate, and answer its queries: a round is due."""
    queries = initial_queries(define(spec), pendulum.INITIAL)
    storage.surrogates.create(records.NewSurrogate(name, spec, pendulum.INITIAL, TARGET, queries))
    for query in storage.queries.claim(name, "tester", pendulum.INITIAL, 60):
        step = pendulum.real_step(list(query.coordinates), list(query.action))
        answer = records.NewSample(**step, query_id=query.id, lease_token=query.token)
        storage.samples.add(name, "tester", [answer])


def fit_all_due(storage: Storage) -> None:
    """One round of each surrogate that is due."""
    definitions = Definitions(storage, define)

    def load(surrogate: int, version: int) -> DynamicsModel:
        return load_model(storage, definitions, surrogate, version)

    async def fit() -> None:
        cache, notices, metrics = ModelCache(load, storage.models.newest), Notices(), ProcessMetrics()
        settings = DesignerSettings("here", threads=1, look_seconds=1.0, fit_seconds=60.0)
        await Designer(storage, definitions, initial_queries, Here(), cache, notices, metrics, settings).fit_all_due()

    asyncio.run(fit())


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("packages")
    for kind in ("acquisition", "model"):
        write_package(EXAMPLES / kind, folder)
    return folder


@pytest.fixture(scope="module")
def left(packages: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    """A server on a database of fits that had the packages: they are gone."""
    folder = tmp_path_factory.mktemp("left")
    with searching(packages), closing(open_storage(f"sqlite:///{folder / 'surrogym.db'}")) as storage:
        for name, design in DESIGNS.items():
            spec = pendulum.spec(budget=pendulum.INITIAL, target=TARGET, **design)
            teach(storage, name, EnvironmentSpec.model_validate(spec).model_dump(mode="json"))
        fit_all_due(storage)
        assert {name: storage.surrogates.get(name).error for name in DESIGNS} == dict.fromkeys(DESIGNS)
    with running_server(folder, PYTHONPATH=with_path(folder)) as server:
        yield server


@pytest.fixture
def surrogym(left: ServerProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Result]:
    """A command of a person's terminal, in this process."""
    monkeypatch.chdir(tmp_path)
    return lambda *words: CliRunner().invoke(build(), [*words, "--server", left.url])


@pytest.mark.parametrize("name", ["lin", "foc"])
@pytest.mark.parametrize(
    "words",
    [
        ("status",),
        ("export", "--out", "samples.csv"),
        ("export", "--out", "spec.json"),
        ("export", "--out", "whole.surrogate"),
        ("report", "--out", "report.html"),
        ("change", "--pause"),
    ],
    ids=" ".join,
)
def test_commands_that_need_no_model_work_after_the_plugin_was_uninstalled(
    surrogym: Callable[..., Result], words: tuple[str, ...], name: str
):
    done = surrogym(words[0], name, *words[1:])
    assert done.exit_code == 0, done.output
    assert (LIN in done.output) == (words[0] == "report" and name == "lin"), "it says why it has no maps"


def refusal(reply: httpx.Response) -> tuple[int, str, str]:
    return reply.status_code, reply.json()["code"], reply.json()["detail"]


def test_requests_that_need_an_uninstalled_model_plugin_are_refused(left: ServerProcess):
    at = f"{left.url}/v1/surrogates/lin"
    points = {"coordinates": [[1.0, 2.0]], "action": [[0.5]]}
    model = httpx.get(f"{at}/models/1?format=safetensors", timeout=60).raise_for_status().content
    octets = {"content-type": "application/octet-stream"}
    for reply in (
        httpx.post(f"{at}/predict", json=points, timeout=60),
        httpx.post(f"{at}/query_uncertainty", json=points, timeout=60),
        httpx.post(f"{at}/sessions", json={"num_envs": 2}, timeout=60),
        httpx.post(f"{at}/models", content=model, headers=octets, timeout=60),
    ):
        assert refusal(reply) == (501, "not_installed", LIN)


def test_a_model_can_be_served_after_its_acquisition_plugin_was_uninstalled(left: ServerProcess):
    points = {"coordinates": [[1.0, 2.0]], "action": [[0.5]]}
    httpx.post(f"{left.url}/v1/surrogates/foc/predict", json=points, timeout=60).raise_for_status()
    opened = httpx.post(f"{left.url}/v1/surrogates/foc/sessions", json={"num_envs": 2}, timeout=60)
    assert opened.status_code == 201


def test_the_server_logs_uninstalled_plugins_at_start(left: ServerProcess):
    assert LIN in left.log
    assert FOC in left.log


@pytest.mark.parametrize(("name", "lacks"), [("lin", LIN), ("foc", FOC)])
def test_a_due_fit_with_an_uninstalled_plugin_fails_with_a_remedy(
    left: ServerProcess, surrogym: Callable[..., Result], name: str, lacks: str
):
    with Api(left.url) as api:
        api.patch_surrogate(name, paused=False)
        step = {"coordinates": [1.0, 2.0], "action": [0.5], "next_coordinates": [1.1, 2.5], "reward": -1.0}
        api.add_samples(name, "tester", [NewSample.model_validate({**step, "terminated": False})])
        api.improve(name, 1)
        deadline = time.monotonic() + 60
        while api.surrogate(name).phase != "failed" and time.monotonic() < deadline:
            time.sleep(0.05)
    seen = surrogym("status", name).output
    assert f"{name}: Pendulum-v1, failed" in seen
    assert f"last error: {lacks}; then: surrogym change {name} --resume" in seen


def test_samples_of_a_surrogate_with_an_uninstalled_plugin_can_be_moved(
    left: ServerProcess, surrogym: Callable[..., Result]
):
    assert surrogym("register", "Pendulum-v1", "--name", "new", "--initial", "2").exit_code == 0
    fields = set(NewSample.model_fields) - {"query_id", "lease_token"}
    with Api(left.url) as api:
        taken = [NewSample.model_validate(sample.model_dump(include=fields)) for sample in api.samples("foc")]
        api.add_samples("new", "import", taken)
        assert api.surrogate("new").ledger.manual == api.surrogate("foc").ledger.total


def test_a_surrogate_with_an_uninstalled_plugin_can_be_deleted(left: ServerProcess, surrogym: Callable[..., Result]):
    assert surrogym("delete", "lin", "--yes").exit_code == 0
    assert httpx.get(f"{left.url}/v1/surrogates/lin", timeout=60).status_code == 404


def test_the_design_continues_after_its_plugin_was_reinstalled(left: ServerProcess, packages: Path, tmp_path: Path):
    """The way out that the status names: install, restart, resume."""
    left.stop()
    shutil.copy(left.folder / "surrogym.db", tmp_path / "surrogym.db")
    with searching(packages), closing(open_storage(f"sqlite:///{tmp_path / 'surrogym.db'}")) as storage:
        before = storage.surrogates.get("foc")
        assert before.phase == "failed"
        storage.surrogates.change("foc", paused=False)
        fit_all_due(storage)
        after = storage.surrogates.get("foc")
        assert (after.round, after.error) == (before.round + 1, None)
        assert after.phase != "failed"
