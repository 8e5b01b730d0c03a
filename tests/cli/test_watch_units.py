"""``surrogym watch`` of steps in other units: it says so, and the policy stays trusted. A drift is no other unit."""

from __future__ import annotations

import threading
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from support.levitation import PENDULUM, Plant, Swing
from support.saying import Said
from support.server import ServerProcess
from support.tank import lines, watched_tank, write
from surrogym_client.surrogates.waiting import wait_for_design
from surrogym_client.transport import Api
from surrogym_client.transport.steps import StepCalls
from surrogym_sampler.queries.settings import SamplerSettings
from surrogym_sampler.queries.worker import Sampler
from surrogym_shared import wire
from surrogym_shared.network import Network
from surrogym_shared.spec import Design
from surrogym_shared.wire.watching import MachineStep

Watch = Callable[..., Said]
DEGREES = 180 / np.pi
Change = Callable[[np.ndarray], np.ndarray]  # of a row (2 + 1 + 1,): angle, speed, action, reward


@pytest.fixture(scope="module")
def swing(server_process: ServerProcess, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A surrogate of the pendulum with a trusted policy."""
    name, path = "units", tmp_path_factory.mktemp("units") / "policy.zip"
    spec = PENDULUM.spec.model_copy(update={"design": Design(initial=32, budget=32)})
    Network.of(spec, np.zeros(3), np.ones(3), 4, np.zeros(Network.size(spec, 4))).save(path)
    with Api(server_process.url) as api:
        api.create_surrogate(name, spec)
        Sampler(api, name, Swing(), SamplerSettings(until_done=True, wait_seconds=1.0)).run()
        wait_for_design(api, name, 120)
        promise = wire.PolicyPromise(median=-1, low=-2, high=0)
        card = wire.PushedCard(spec=spec, promise=promise, trusted=True, reason="an audit passed")
        api.policies.push(name, card, [], "zip", path.read_bytes())
        yield name
        api.delete_surrogate(name)


@pytest.fixture
def post(swing: str, server_process: ServerProcess) -> Iterator[Callable[[Plant, Change, int], None]]:
    """Posts steps of a pendulum whose values are changed. Real episodes make the next test begin after them."""

    def send(plant: Plant, change: Change, batch: int) -> None:
        rng, q, steps, stream = np.random.default_rng(7), np.array([3.0, 0.0]), [], uuid.uuid4().hex
        for _ in range(60):
            u = rng.uniform(-1, 1, 1)
            moved = plant.step_from(q, u)
            angle, speed, action, reward = change(np.array([*q, *u, moved.reward])).tolist()
            q = np.asarray(moved.next_coordinates)
            after = change(np.array([*q, 0.0, 0.0]))[:2].tolist()
            step = {"coordinates": [angle, speed], "action": [action], "next_coordinates": after, "reward": reward}
            steps.append(MachineStep.model_validate(step))
        with Api(server_process.url) as api:
            for first in range(0, len(steps), batch):
                environment, some = PENDULUM.spec.environment, steps[first : first + batch]
                StepCalls(api.connection).add(swing, environment, stream, first, some)

    yield send
    with Api(server_process.url) as api:
        again = {"first_seed": 1, "returns": [-1.0] * 30, "lengths": [9] * 30, "idempotency_key": uuid.uuid4().hex}
        kept = wire.AddEvaluation.model_validate(again)
        api.policies.evaluate(swing, 1, kept)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda row: row * [DEGREES, 1, 1, 1], "angle seems to come in other units: seen = 57.3 times expected"),
        (lambda row: row * [DEGREES, DEGREES, 1, 1], "angle and speed seem to come in other units: seen = 57.3 times"),
        (lambda row: row * [1, 1, 1, 1_000], "reward seems to come in other units: seen = 1000 times expected"),
        (lambda row: row * [1, 1, 0.01, 1], "action 0 seems to come in other units: seen = 0.01 times expected"),
    ],
    ids=["degrees", "degrees per second", "rewards", "actions"],
)
def test_steps_in_other_units_are_refused_and_the_policy_stays_trusted(
    on_server: Watch,
    swing: str,
    server_process: ServerProcess,
    post: Callable[[Plant, Change, int], None],
    change: Change,
    named: str,
):
    """They were an alarm, which took the trust away."""
    post(Swing(), change, 60)
    said = on_server("watch", swing, "--policy", "1")
    assert said.code == 2, said.out + said.err
    assert named in said.out
    as_json = on_server("watch", swing, "--policy", "1", "--json")
    assert (as_json.code, as_json.json["drift"], as_json.json["trusted"]) == (2, None, None)
    assert named in as_json.json["other_units"]
    with Api(server_process.url) as api:
        assert api.policies.get(swing, 1).trusted is True


def test_a_later_stream_in_the_right_units_is_watched(
    on_server: Watch, swing: str, post: Callable[[Plant, Change, int], None], tmp_path: Path
):
    """The program that posted degrees was mended, and began another stream."""
    post(Swing(), lambda row: row * [DEGREES, 1, 1, 1], 60)
    post(Swing(), lambda row: row, 60)
    said = on_server("watch", swing, "--policy", "1")
    assert said.code == 0, said.out + said.err
    assert "is left out: angle seems to come in other units: seen = 57.3 times expected" in said.out
    assert "no drift in 60 real steps" in said.out


def test_a_machine_that_changed_before_the_first_step_is_a_drift(
    on_server: Watch, swing: str, post: Callable[[Plant, Change, int], None]
):
    post(Plant(PENDULUM, {**PENDULUM.real, "pump": 0.5}), lambda row: row, 60)
    said = on_server("watch", swing, "--policy", "1")
    assert (said.code, "drift, found in stream " in said.out) == (1, True), said.out
    assert "may be of another machine or in other units" in said.out


def test_other_units_are_recognised_in_steps_that_come_one_by_one(
    on_server: Watch, swing: str, post: Callable[[Plant, Change, int], None], monkeypatch: pytest.MonkeyPatch
):
    """The evidence of drift is there after three steps, too early to tell one from the other."""
    monkeypatch.setattr("surrogym_trainer.watching.streams.LOOK_SECONDS", 0.01)
    later = threading.Thread(target=post, args=(Swing(), lambda row: row * [DEGREES, 1, 1, 1], 1))
    later.start()
    try:
        said = on_server("watch", swing, "--policy", "1", "--follow")
    finally:
        later.join()
    assert (said.code, "angle seems to come in other units" in said.out) == (2, True), said.out


def test_actions_in_percent_are_rejected_and_the_policy_stays_trusted(
    on_server: Watch, server_process: ServerProcess, tmp_path: Path
):
    with watched_tank(server_process.url, tmp_path) as tank:
        cells = [line.split(",") for line in lines(100, seed=31)]
        log = write(tmp_path / "log.csv", [f"{t},{q},{100 * float(u)},{paid}" for t, q, u, paid in cells])
        said = on_server("watch", tank, str(log), "--policy", "production")
        assert said.code == 1
        assert "action: expected a value in [-1, 1]" in said.err
        with Api(server_process.url) as api:
            assert api.policies.get(tank, 1).trusted is True
