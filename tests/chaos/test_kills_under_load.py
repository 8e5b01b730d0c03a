"""kill -9 of raylets, session hosts, the head of Ray, PostgreSQL, HAProxy and front servers, under the load of samplers
and trainings; and of a front server every five seconds, which changes no bit of a policy."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from support.chaos import SEED, times
from support.disturbed import disturbed_training, require_same_policy
from support.haproxy import program
from support.load import load
from support.stage import Stage, killing_fronts, running_stage
from support.teaching import teach
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum

pytest.importorskip("ray")

KILLS = times(short=1, full=20)
TRAININGS = min(KILLS, 5)  # times 4,096 virtual steps
BUDGET = 12  # real steps of one design
LATEST = 1.0  # seconds until a kill, after all have made progress since the last one
FRONT_SECONDS = 5.0  # from one kill of a front server to the next

pytestmark = [
    pytest.mark.postgresql,
    pytest.mark.timeout(7_200),
    pytest.mark.skipif(program() is None, reason="HAProxy is not on this machine: apt-get install haproxy"),
]

STRIKES: dict[str, Callable[[Stage, random.Random], None]] = {
    "haproxy": lambda stage, _: stage.kill_proxy(),
    "postgresql": lambda stage, _: stage.kill_postgresql(),
    "raylet": lambda stage, source: stage.kill_raylet(source.choice([1, 2])),
    "session host": lambda stage, source: stage.kill_host(source),
    "head": lambda stage, _: stage.kill_head(),
    "front server": lambda stage, source: stage.kill_front(source.choice([0, 1])),
}
HARMLESS = ("haproxy", "front server")


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stage]:
    """A cluster that has the surrogate ``pendulum``."""
    with running_stage(tmp_path_factory.mktemp("stage")) as running:
        with Api(running.url) as api:
            teach(api, "pendulum", pendulum(), queries=12)
        yield running


@pytest.mark.parametrize("what", STRIKES)
def test_kills_of_cluster_processes_under_load_lose_no_sample_and_repeat_no_step(
    stage: Stage, what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Designs complete and trainings end. Only kills of what holds sessions may cut episodes short."""
    source, begun = random.Random(SEED), time.monotonic()
    with Api(stage.url) as api, load(api, stage.url, tmp_path, what.replace(" ", "-"), BUDGET) as working:
        for _ in range(KILLS):
            working.progress()
            time.sleep(source.uniform(0.0, LATEST))
            STRIKES[what](stage, source)
            working.designs.tally.kills += 1
        working.progress()
    cut = sum(result.lost_episodes for result in working.results)
    with capsys.disabled():
        print(f"\n{what}, {working.designs.tally}; {len(working.results)} trainings ended, {cut} episodes cut short")
        print(f"{time.monotonic() - begun:.0f} s")
    assert len(working.results) >= len(working.trainings)
    assert not (cut and what in HARMLESS)


def test_a_training_learns_the_same_policy_while_front_servers_are_killed_repeatedly(
    stage: Stage, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    calm = disturbed_training(stage.url, tmp_path / "calm.zip", TRAININGS)
    begun = time.monotonic()
    with killing_fronts(stage, FRONT_SECONDS) as kills:
        killed = disturbed_training(stage.url, tmp_path / "killed.zip", TRAININGS)
    with capsys.disabled():
        print(f"\n{len(kills)} kills of front servers in {time.monotonic() - begun:.0f} s of a PPO training")
    assert kills
    require_same_policy(killed, calm)
