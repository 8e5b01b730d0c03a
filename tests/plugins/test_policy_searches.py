"""Policy searches of other packages: installed, found by name, held to the same laws as the built-in ones."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from support.models import learn
from support.real_steps import random_steps
from support.searched import write_package
from support.server import ServerProcess, running_server
from surrogym_sampler.diagnosis.doctor import installation
from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.local import LocalSurrogate
from surrogym_server.models.registry import MODELS
from surrogym_server.sampling.acquisition import ACQUISITIONS
from surrogym_shared.port import SurrogatePort
from surrogym_trainer.testing import POLICY_SEARCH_LAWS
from surrogym_trainer.training import TrainSettings
from surrogym_trainer.training.search import SEARCHES

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "plugins" / "policy_search"
PAGE = ROOT / "docs" / "how-to" / "plugins.md"
SEARCHED = {  # small enough to take a second each
    "PPO": {"n_steps": 16, "batch_size": 32, "n_epochs": 2},
    "FASTPPO": {"n_steps": 16, "batch_size": 32, "n_epochs": 2},
    "SAC": {"learning_starts": 32, "batch_size": 16},
    "CMAES": {"population": 4, "starts": 2, "units": 2},
    "PLANNER": {"horizon": 3},
    "cross_entropy": {"population": 8, "starts": 2, "units": 2},
}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the example package, and packages that are broken."""
    folder = tmp_path_factory.mktemp("site")
    write_package(EXAMPLE, folder)
    broken(folder, "missing_module", "nowhere_to_be_found:Missing")
    broken(folder, "no_search", "json:JSONDecoder")
    broken(folder, "ppo", "json:JSONDecoder")
    return folder


def broken(folder: Path, name: str, value: str, group: str = "policy_searches") -> None:
    written = folder / f"package_of_{name}-1.0.dist-info"
    written.mkdir()
    (written / "METADATA").write_text(f"Metadata-Version: 2.1\nName: package_of_{name}\nVersion: 1.0\n")
    (written / "entry_points.txt").write_text(f"[surrogym.{group}]\n{name} = {value}\n")


@pytest.fixture
def installed(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The packages in this process, whose registry looks for them anew."""
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.setattr(SEARCHES, "_installed", None)
    monkeypatch.setattr(SEARCHES, "_broken", {})


@pytest.fixture(scope="module")
def surrogate() -> LocalSurrogate:
    """Short episodes, so that a generation is short."""
    spec = pendulum().model_copy(update={"time_limit": 20})
    return LocalSurrogate(spec, learn(definition_from_spec(spec), random_steps(spec, 8, seed=0)).model)


@pytest.mark.parametrize("law", POLICY_SEARCH_LAWS)
@pytest.mark.parametrize("name", SEARCHED)
@pytest.mark.usefixtures("installed")
def test_every_policy_search_passes_the_policy_search_interface_tests(
    surrogate: LocalSurrogate, tmp_path: Path, name: str, law: Callable[[SurrogatePort, TrainSettings, Path], None]
):
    settings = TrainSettings(algorithm=name, total_steps=1_280, num_envs=8, hyperparameters=SEARCHED[name])
    law(surrogate, settings, tmp_path)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("nobody", "expected one of A2C, DDPG, DQN, PPO, SAC, TD3, FASTPPO, CMAES, PLANNER, cross_entropy"),
        ("missing_module", "package 'package_of_missing_module', entry point missing_module = 'nowhere_to_be_found"),
        ("missing_module", "No module named 'nowhere_to_be_found'"),
        ("no_search", "expected a subclass of surrogym_trainer.training.search.PolicySearch, got <class 'json"),
    ],
)
@pytest.mark.usefixtures("installed")
def test_an_unknown_or_broken_policy_search_gives_a_one_sentence_error(name: str, said: str):
    with pytest.raises(ValueError, match=f"got '{name}'") as refused:
        SEARCHES.get(name)
    assert said in str(refused.value)


@pytest.mark.usefixtures("installed")
def test_a_plugin_cannot_take_the_name_of_a_built_in_policy_search():
    assert SEARCHES.get("ppo").__module__.startswith("surrogym_trainer.")
    assert "expected a name that differs from the built-in" in SEARCHES.broken["ppo"]


@pytest.mark.usefixtures("installed")
def test_the_doctor_command_names_policy_search_plugins_that_cannot_be_used():
    problems = [finding for finding in installation() if finding.way_out]
    assert [finding.name for finding in problems] == ["plug-in"] * 3
    assert "package 'package_of_no_search', entry point no_search = " in " ".join(f.said for f in problems)


def test_the_doctor_command_names_broken_server_plugins_in_one_line_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "talkative.py").write_text("raise RuntimeError('one line\\nand another')\n")
    (tmp_path / "leaving.py").write_text("import sys\nsys.exit(3)\n")
    broken(tmp_path, "talkative", "talkative:Missing", "acquisitions")
    broken(tmp_path, "leaving", "leaving:Missing", "models")
    monkeypatch.syspath_prepend(str(tmp_path))
    for registry in (SEARCHES, ACQUISITIONS, MODELS):
        monkeypatch.setattr(registry, "_installed", None)
        monkeypatch.setattr(registry, "_broken", {})
    said = [finding.said for finding in installation() if finding.way_out]
    assert [line.partition(" is left out")[0] for line in said] == [
        "the acquisition 'talkative'",
        "the model 'leaving'",
    ]
    assert "RuntimeError: one line and another" in said[0]
    assert "SystemExit: 3" in said[1]


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    with running_server(tmp_path_factory.mktemp("server")) as server:
        yield server


def test_an_installed_policy_search_plugin_solves_pendulum_over_http(server: ServerProcess, site: Path, tmp_path: Path):
    """Register, sample, train, evaluate, export: the commands of a person who installed the package."""

    def surrogym(*arguments: str) -> str:
        checkout = [str(ROOT / part) for part in ("server", "client", "shared")]
        done = subprocess.run(
            [sys.executable, "-m", "surrogym", *arguments],
            env={"PYTHONPATH": ":".join([str(site), *checkout]), "SURROGYM_URL": server.url, "PATH": ""},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=280,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    surrogym("register", "Pendulum-v1", "--name", "pendulum", "--seed", "0")
    surrogym("sample", "pendulum", "--until-done", "--quiet")
    said = surrogym("train", "pendulum", "--algorithm", "cross_entropy", "--quiet", "--json")
    trained = json.loads(said)
    assert trained["algorithm"] == "cross_entropy"
    assert 1_000_000 < trained["virtual_steps"] <= 2_000_000
    evaluated = json.loads(surrogym("evaluate", "policy.zip", "--episodes", "20", "--json", "--quiet"))
    assert evaluated["mean"] > -900, "a random policy earns about -1,200"
    surrogym("export-policy", "policy.zip", "--out", "policy.pt2", "--quiet")
    assert (tmp_path / "policy.pt2").exists()


def test_the_plugin_page_names_the_existing_entry_point_of_the_example_search():
    assert "`examples/plugins/policy_search`" in PAGE.read_text()
    assert 'cross_entropy = "cross_entropy:CrossEntropy"' in (EXAMPLE / "pyproject.toml").read_text()
