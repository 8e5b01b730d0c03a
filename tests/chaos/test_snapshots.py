"""Designs with snapshots: kill -9 of the sampler at random moments, with a folder that stays and with one that ends
with it; and two samplers that drop each other's snapshots. No sample is lost, and no snapshot stays known without its
file."""

from __future__ import annotations

import random
import time
from pathlib import Path

import pytest

from support.chaos import SEED, times
from support.noting import until
from support.saving import STEP_SECONDS, SavingSamplers, create, ended, require_no_dead_snapshots, require_true
from support.server import running_server
from surrogym_client.transport import Api

KILLS, KILLS_A_RUN = times(short=2, full=40), 10
RACES = times(short=1, full=20)
BUDGET, RACE_BUDGET = times(short=8, full=24), times(short=12, full=24)  # real steps
LATEST = 6 * STEP_SECONDS  # from the first step of a sampler to its kill
FEW = 5  # snapshots in the folder of two samplers

pytestmark = pytest.mark.slow


@pytest.mark.timeout(3_600)
@pytest.mark.parametrize("stays", [pytest.param(True, id="folder"), pytest.param(False, id="no-folder")])
def test_killed_samplers_lose_no_sample_and_report_lost_snapshots(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], stays: bool
):
    source, kills, steps = random.Random(SEED), 0, [0, 0, 0]
    snapshots = tmp_path / "snapshots" if stays else None
    with running_server(tmp_path) as server, Api(server.url) as api:
        while kills < KILLS:
            name = f"run-{kills}"
            create(api, name, BUDGET)
            samplers = SavingSamplers(server.url, name, tmp_path / name, snapshots)
            for _ in range(min(KILLS_A_RUN, KILLS - kills)):
                kills += _kill_one(samplers, source)
            assert until(lambda: _goes_on(api, name, samplers)), f"the design completes, but is {api.surrogate(name)}"  # noqa: B023
            assert _until_done(samplers) == 0, (
                "a sampler that starts after the design has ended still reports which snapshots are gone"
            )
            require_no_dead_snapshots(api, name, snapshots)
            notes, view = samplers.notes(), api.surrogate(name)
            require_true(api, name, notes, BUDGET)
            now = (notes.begun, view.ledger.total, view.ledger.unresolved)
            steps = [before + these for before, these in zip(steps, now, strict=True)]
        assert "Traceback" not in server.log
    with capsys.disabled():
        print(f"\n{kills} kills: {steps[0]} real steps begun, {steps[1]} stored, at most {steps[2]} unresolved")


@pytest.mark.timeout(3_600)
def test_two_samplers_that_drop_each_others_snapshots_lose_no_sample(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    told: dict[str, int] = {}
    with running_server(tmp_path) as server, Api(server.url) as api:
        for run in range(RACES):
            name, folder = f"race-{run}", tmp_path / "snapshots"
            create(api, name, RACE_BUDGET)
            samplers = SavingSamplers(server.url, name, tmp_path / name, folder, FEW)
            both = [samplers.start() for _ in range(2)]
            for process in both:
                process.join()
            assert [process.exitcode for process in both] == [0, 0]
            notes, ledger = samplers.notes(), api.surrogate(name).ledger
            require_true(api, name, notes, RACE_BUDGET)
            require_no_dead_snapshots(api, name, folder)
            assert (notes.begun, ledger.unresolved) == (ledger.total, 0)
            assert all("it was deleted" in error for outcome, error in notes.said if outcome != "answered")
            errors = {error for outcome, error in notes.said if outcome == "answered" and error}
            assert all("that the server knew" in error for error in errors), "no rollout is cut short"
            for outcome, _ in notes.said:
                told[outcome] = told.get(outcome, 0) + 1
        assert "Traceback" not in server.log
    with capsys.disabled():
        print(f"\n{RACES} races: {told}")


def _kill_one(samplers: SavingSamplers, source: random.Random) -> int:
    """Start a sampler and kill it at a random moment after its first step; the number of kills."""
    before, process = samplers.notes().begun, samplers.start()
    until(lambda: samplers.notes().begun > before or not process.is_alive())
    time.sleep(source.uniform(0.0, LATEST))
    killed = int(process.is_alive())
    process.kill()
    process.join()
    return killed


def _goes_on(api: Api, name: str, samplers: SavingSamplers) -> bool:
    """Sample without kills, and return whether the design has ended. If kills have set all of its first queries aside,
    the design has failed, and is resumed as a person would do it."""
    assert _until_done(samplers) == 0
    if api.surrogate(name).phase == "failed":
        api.patch_surrogate(name, paused=False)
    return ended(api, name)


def _until_done(samplers: SavingSamplers) -> int:
    process = samplers.start()
    process.join()
    assert isinstance(process.exitcode, int)
    return process.exitcode
