"""A surrogate outlives the package of its family of models or its acquisition: all that is stored can be read."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
from typer.testing import CliRunner, Result

from support.searched import with_path
from support.server import ServerProcess, running_server
from support.teaching import teach
from surrogym_client.cli import build
from surrogym_client.original.classic import pendulum
from surrogym_client.transport import Api
from surrogym_shared.spec import AcquisitionChoice, Design
from surrogym_shared.wire import NewSample

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "plugins.md"
FOCUSED = AcquisitionChoice(name="focused_variance", settings={"coordinate": "speed"})
INSTALL = "which no installed package brings: install it on the server and restart"
LIN = f"surrogate lin needs the model family 'bayesian_linear', {INSTALL}"
FOC = f"surrogate foc needs the acquisition 'focused_variance', {INSTALL}"


@pytest.fixture(scope="module")
def left(installed: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    """A server on the database of another one that had the packages: they are gone."""
    folder = tmp_path_factory.mktemp("left")
    with running_server(folder, PYTHONPATH=with_path(installed)) as server, Api(server.url) as api:
        small = Design(target=0.99999, model="bayesian_linear")
        teach(api, "lin", pendulum().model_copy(update={"design": small}), queries=6)
        teach(api, "foc", pendulum().model_copy(update={"design": Design(acquisition=FOCUSED)}), queries=6)
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
def test_what_is_stored_is_read_written_out_and_paused(
    surrogym: Callable[..., Result], words: tuple[str, ...], name: str
):
    done = surrogym(words[0], name, *words[1:])
    assert done.exit_code == 0, done.output
    assert (LIN in done.output) == (words[0] == "report" and name == "lin"), "it says why it has no maps"


def refusal(reply: httpx.Response) -> tuple[int, str, str]:
    return reply.status_code, reply.json()["code"], reply.json()["detail"]


def test_what_needs_the_family_is_refused_and_says_what_the_server_lacks(left: ServerProcess):
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


def test_a_model_serves_without_the_acquisition(left: ServerProcess):
    points = {"coordinates": [[1.0, 2.0]], "action": [[0.5]]}
    httpx.post(f"{left.url}/v1/surrogates/foc/predict", json=points, timeout=60).raise_for_status()
    opened = httpx.post(f"{left.url}/v1/surrogates/foc/sessions", json={"num_envs": 2}, timeout=60)
    assert opened.status_code == 201


def test_the_log_names_who_lacks_what_from_the_start(left: ServerProcess):
    assert LIN in left.log
    assert FOC in left.log


@pytest.mark.parametrize(("name", "lacks"), [("lin", LIN), ("foc", FOC)])
def test_a_round_that_is_due_fails_and_says_what_to_do(
    left: ServerProcess, surrogym: Callable[..., Result], name: str, lacks: str
):
    with Api(left.url) as api:
        api.patch_surrogate(name, paused=False)
        step = {"coordinates": [1.0, 2.0], "action": [0.5], "next_coordinates": [1.1, 2.5], "reward": -1.0}
        api.add_samples(name, "tester", [NewSample.model_validate({**step, "terminated": False})])
        api.improve(name, 1)
        api.claim(name, "tester", wait_seconds=30.0)
    seen = surrogym("status", name).output
    assert f"{name}: Pendulum-v1, failed" in seen
    assert f"last error: {lacks}; then: surrogym change {name} --resume" in seen


def test_the_samples_go_along_to_a_new_design_as_the_page_says(left: ServerProcess, surrogym: Callable[..., Result]):
    (program,) = re.findall(
        r"^```py\n(from surrogym_client.transport.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE
    )
    assert surrogym("register", "Pendulum-v1", "--name", "new", "--initial", "2").exit_code == 0
    exec(program.replace("http://127.0.0.1:8000", left.url).replace('"old"', '"foc"'), {})
    with Api(left.url) as api:
        assert api.surrogate("new").ledger.manual == api.surrogate("foc").ledger.total


def test_it_can_be_deleted(left: ServerProcess, surrogym: Callable[..., Result]):
    assert surrogym("delete", "lin", "--yes").exit_code == 0
    assert httpx.get(f"{left.url}/v1/surrogates/lin", timeout=60).status_code == 404


def test_installed_again_the_design_goes_on(left: ServerProcess, installed: Path, tmp_path: Path):
    """The way out that the status names: install, restart, resume."""
    left.stop()
    shutil.copy(left.folder / "surrogym.db", tmp_path / "surrogym.db")
    with running_server(tmp_path, PYTHONPATH=with_path(installed)) as server, Api(server.url) as api:
        assert api.surrogate("foc").phase == "failed"
        api.patch_surrogate("foc", paused=False)
        claimed = api.claim("foc", "tester", wait_seconds=60.0)
        assert claimed.phase != "failed"
        assert api.surrogate("foc").error is None
