"""kill -9 of the server at random moments of a design with three samplers: nothing acknowledged is lost, nothing is
there twice, the design completes, and the ledger tells the truth."""

from __future__ import annotations

import random
import signal
from pathlib import Path

import pytest

from support.chaos import SEED, times
from support.noting import Tally, create, finished, noting_samplers, until
from support.server import RestartingServer
from surrogym_client.transport import Api

SAMPLERS, BUDGET, KILLS_A_RUN = 3, times(short=9, full=18), 10
LONGEST_LIFE = 2.0
LEASE_SECONDS = 4.0  # a restart takes as long, so that some leases end meanwhile


@pytest.mark.timeout(7_200)
@pytest.mark.parametrize(
    ("kills", "with_samplers"),
    [
        pytest.param(times(short=1, full=100), False, id="alone"),
        pytest.param(times(short=1, full=20), True, id="with-its-samplers"),
    ],
)
def test_a_killed_server_loses_no_acknowledged_sample_and_keeps_a_correct_ledger(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kills: int, with_samplers: bool
):
    source, tally = random.Random(SEED), Tally()
    server = RestartingServer(tmp_path)
    try:
        while tally.kills < kills:
            name = f"run-{tally.kills}"
            folder = tmp_path / name
            with (
                Api(server.url) as api,
                noting_samplers(server.url, name, folder, count=0, lease_seconds=LEASE_SECONDS) as samplers,
            ):
                create(api, name, BUDGET)
                for _ in range(SAMPLERS):
                    samplers.start()
                until(samplers.in_a_step)
                for _ in range(min(KILLS_A_RUN, kills - tally.kills)):
                    done = until(lambda: finished(api, name), seconds=source.uniform(0.0, LONGEST_LIFE))  # noqa: B023
                    if with_samplers and not done:
                        until(samplers.in_a_step, seconds=LONGEST_LIFE)
                    server.stop(signal.SIGKILL)
                    tally.kills += 1
                    if with_samplers:
                        samplers.replace_all()
                    server.start()
                    if done:
                        break
                assert until(lambda: finished(api, name)), f"the design completes, but is {api.surrogate(name)}"  # noqa: B023
                assert until(lambda: not samplers.in_a_step()), "whoever took a step hands it in"
                tally.judge(api, name, samplers.notes(), patient=not with_samplers)
                assert len(api.queries(name)) >= BUDGET, "each answered, or set aside after three kills in its step"
    finally:
        server.stop()
    with capsys.disabled():
        print(f"\nthe server, {tally}")
