"""The example programs keep the protocol, and the cart-pole in C has the physics of Gymnasium's."""

from __future__ import annotations

import shlex
import shutil
import subprocess

import numpy as np
import pytest

from support.examples import ROOT
from surrogym_sampler import original
from surrogym_sampler.diagnosis.executables import conformance
from surrogym_sampler.original.classic import cartpole
from surrogym_shared.spec import EnvironmentSpec

FOLDER = ROOT / "examples" / "executables"
ALMOST = 1e-14  # a unit in the last place of sin or cos, which C's library and numpy round differently


def needed(name: str, package: str) -> str:
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not on this machine, so its example is not run. To run it: apt-get install {package}")
    return path


@pytest.fixture(scope="module")
def cartpole_in_c(tmp_path_factory: pytest.TempPathFactory) -> str:
    compiler, to = needed("cc", "gcc libc6-dev"), tmp_path_factory.mktemp("cartpole") / "cartpole"
    strict = ["-std=c11", "-Wall", "-Wextra", "-Werror", "-O2", "-ffp-contract=off"]
    subprocess.run([compiler, *strict, "-o", str(to), str(FOLDER / "cartpole.c"), "-lm"], check=True)
    return shlex.join([str(to), str(FOLDER / "cartpole.json")])


@pytest.fixture
def tank_in_node() -> str:
    return shlex.join([needed("node", "nodejs"), str(FOLDER / "tank.mjs")])


@pytest.fixture
def rail_in_shell() -> str:
    return shlex.join(["sh", str(FOLDER / "rail.sh")])


@pytest.mark.parametrize("example", ["cartpole_in_c", "tank_in_node", "rail_in_shell"])
def test_every_example_program_passes_the_protocol_checks(example: str, request: pytest.FixtureRequest):
    checked = list(conformance(request.getfixturevalue(example), 30.0))
    assert {outcome.name: outcome.failure for outcome in checked if outcome.failure} == {}
    assert len(checked) > 10


def test_the_cart_pole_example_in_c_steps_like_gymnasium(cartpole_in_c: str):
    rng, task = np.random.default_rng(0), original.make("CartPole-v1")
    plant = original.make(f"exec:{cartpole_in_c}")
    try:
        for _ in range(200):
            q, u = rng.uniform([-3, -3, -0.3, -3], [3, 3, 0.3, 3]), rng.integers(0, 2, 1).astype(float)
            expected, came = task.step_from(q, u), plant.step_from(q, u)
            assert np.allclose(came.next_coordinates, expected.next_coordinates, rtol=0, atol=ALMOST)
            assert (came.reward, came.terminated) == (expected.reward, expected.terminated)
    finally:
        plant.close()
        task.close()


def test_the_cart_pole_example_in_c_declares_the_spaces_and_limits_of_gymnasium():
    own = EnvironmentSpec.model_validate_json((FOLDER / "cartpole.json").read_text())
    assert own == cartpole().model_copy(update={"environment": "cartpole-c"})
