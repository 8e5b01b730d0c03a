"""A surrogate leaves a server as one file, and steps as the served one does, in another server and in this process."""

from __future__ import annotations

from pathlib import Path
from uuid import uuid4

import gymnasium
import numpy as np
import pytest

from support.server import ServerProcess
from surrogym_client.environments import open_file
from surrogym_client.errors import InvalidInput, UnknownSurrogate
from surrogym_client.sb3 import SurrogateVecEnv
from surrogym_client.surrogates.transfer import NotImportable, export_surrogate, import_surrogate
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_sampler.original.classic import cartpole
from surrogym_shared.port import StepResult, SurrogatePort
from surrogym_shared.surrogate_file import SurrogateFile
from surrogym_shared.wire import OpenSession

LANES, STEPS = 3, 12


@pytest.fixture(scope="module")
def file(pendulum_server: ServerProcess, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("file") / "pendulum.surrogate"
    with Api(pendulum_server.url) as api:
        path.write_bytes(export_surrogate(api, "pendulum").to_bytes())
    return path


@pytest.fixture
def name() -> str:
    return f"imported-{uuid4().hex[:8]}"


def steps_of(port: SurrogatePort, variant: str) -> list[StepResult]:
    options = {"particles": 50} if variant == "probabilistic" else {}
    session = port.open(OpenSession(num_envs=LANES, seed=5, variant=variant, time_limit=9, **options)).id
    port.reset(session)
    actions = np.random.default_rng(0).uniform(-2, 2, (STEPS, LANES, 1))
    steps = [port.step(session, action, deviations=True) for action in actions]
    port.close(session)
    return steps


def assert_same(ours: list[StepResult], theirs: list[StepResult]) -> None:
    for a, b in zip(ours, theirs, strict=True):
        for field in ("observation", "reward", "reward_mean", "terminated", "truncated", "deviation"):
            np.testing.assert_array_equal(getattr(a, field), getattr(b, field))


@pytest.mark.parametrize("variant", ["deterministic", "probabilistic", "pathwise"])
def test_an_exported_surrogate_file_steps_bit_equal_to_the_server(
    pendulum_server: ServerProcess, file: Path, variant: str
) -> None:
    with HttpSurrogate(pendulum_server.url, "pendulum") as served:
        assert_same(steps_of(open_file(file), variant), steps_of(served, variant))


def test_an_imported_surrogate_steps_the_same_and_keeps_its_ledger(
    pendulum_server: ServerProcess, file: Path, name: str
) -> None:
    read = SurrogateFile.load(file)
    with Api(pendulum_server.url) as api, HttpSurrogate(pendulum_server.url, name) as imported:
        view = import_surrogate(api, read, name)
        assert (view.paused, view.model_version, view.ledger.manual) == (True, 1, len(read.samples))
        assert view.fidelity == api.surrogate("pendulum").fidelity, "judged by the same tolerances"
        assert read.ledger["initial"] + read.ledger["adaptive"] + read.ledger["manual"] == len(read.samples)
        with HttpSurrogate(pendulum_server.url, "pendulum") as served:
            assert_same(steps_of(imported, "deterministic"), steps_of(served, "deterministic"))
        again = export_surrogate(api, name)
        for field in ("coordinates", "action", "next_coordinates", "reward", "terminated"):
            np.testing.assert_array_equal(getattr(again.samples, field), getattr(read.samples, field))
        with pytest.raises(NotImportable, match="exists already"):
            import_surrogate(api, read, name)


def test_importing_a_surrogate_file_with_a_model_of_another_system_stores_nothing(
    pendulum_server: ServerProcess, file: Path, name: str
) -> None:
    read = SurrogateFile.load(file)
    mixed = SurrogateFile(name, cartpole(), read.model, read.samples)
    with Api(pendulum_server.url) as api:
        with pytest.raises(InvalidInput):
            import_surrogate(api, mixed)
        with pytest.raises(UnknownSurrogate):
            api.surrogate(name)


def interrupted(_: float) -> None:
    raise KeyboardInterrupt


class Overtaken(Api):
    """Another person imports the same file under the same name just before this one's import creates it."""

    def create_surrogate(self, name, spec):
        with Api(self.connection.url) as other:
            import_surrogate(other, self.theirs, name)
        return super().create_surrogate(name, spec)


def test_of_two_simultaneous_imports_the_later_does_not_delete_the_first(
    pendulum_server: ServerProcess, file: Path, name: str
) -> None:
    read = SurrogateFile.load(file)

    with Overtaken(pendulum_server.url) as api:
        api.theirs = read
        with pytest.raises(NotImportable, match="exists already"):
            import_surrogate(api, read, name, interrupted)
        assert api.surrogate(name).samples == len(read.samples)


def test_an_interrupted_surrogate_import_leaves_no_surrogate(
    pendulum_server: ServerProcess, file: Path, name: str
) -> None:
    with Api(pendulum_server.url) as api:
        with pytest.raises(KeyboardInterrupt):
            import_surrogate(api, SurrogateFile.load(file), name, interrupted)
        with pytest.raises(UnknownSurrogate):
            api.surrogate(name)


def test_a_surrogate_file_can_be_used_with_gymnasium_and_stable_baselines3(file: Path) -> None:
    env = gymnasium.make("surrogym/File-v0", file=file)
    first, _ = env.reset(seed=1)
    assert env.observation_space.contains(first)
    assert env.step(env.action_space.sample())[4]["model_version"] == 1
    envs = gymnasium.make_vec("surrogym/File-v0", num_envs=2, file=file)
    starts, _ = envs.reset(seed=1)
    np.testing.assert_array_equal(starts[0], first)
    lanes = SurrogateVecEnv.from_port(open_file(file), num_envs=2, seed=1)
    assert lanes.reset().shape == (2, 3)
    for opened in (env, envs, lanes):
        opened.close()
