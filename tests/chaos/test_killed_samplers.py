"""kill -9 of samplers in the middle of a step: their queries go to others or are set aside, and no step is hidden. One
that slept beyond its lease takes no step that others have taken meanwhile."""

from __future__ import annotations

import random
import signal
import time
from pathlib import Path

import pytest

from support.chaos import SEED, times
from support.noting import NotingSamplers, Tally, create, finished, noting_samplers, until
from support.server import running_server
from surrogym_client.transport import Api

KILLS = times(short=3, full=50)
SAMPLERS, BUDGET, KILLS_A_RUN = 3, times(short=9, full=16), 10
LEASE_SECONDS = 2.0
LATEST, LOOK_SECONDS = 0.06, 0.01  # into a step; between looks


def kill_one(source: random.Random, samplers: NotingSamplers) -> bool:
    """Kill one that is in the middle of a step, at a random moment of it, and start another in its place; whether
    anybody was."""
    working = samplers.in_a_step()
    if working:
        time.sleep(source.uniform(0.0, LATEST))
        samplers.kill(source.choice(working))
        samplers.start()
    return bool(working)


@pytest.mark.timeout(3_600)
def test_with_killed_samplers_every_query_ends_answered_or_set_aside(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    source, tally = random.Random(SEED), Tally()
    with running_server(tmp_path) as server, Api(server.url) as api:
        while tally.kills < KILLS:
            name = f"run-{tally.kills}"
            create(api, name, BUDGET)
            folder = tmp_path / name
            with noting_samplers(server.url, name, folder, count=SAMPLERS, lease_seconds=LEASE_SECONDS) as samplers:
                wanted = min(tally.kills + KILLS_A_RUN, KILLS)
                while tally.kills < wanted and not finished(api, name):
                    tally.kills += kill_one(source, samplers)
                    time.sleep(LOOK_SECONDS)
                assert until(lambda: finished(api, name)), f"the design completes, but is {api.surrogate(name)}"  # noqa: B023
                assert until(lambda: not samplers.in_a_step()), "whoever took a step hands it in"
            tally.judge(api, name, samplers.notes(), patient=False)
        assert "Traceback" not in server.log
    with capsys.disabled():
        print(f"\nsamplers, {tally}")


def test_a_sampler_suspended_beyond_its_lease_repeats_no_step_of_others(tmp_path: Path):
    """As after closing a laptop: it holds six queries, and is stopped in the first step."""
    with running_server(tmp_path) as server, Api(server.url) as api:
        create(api, "slept", budget=6)
        with noting_samplers(server.url, "slept", tmp_path / "notes", count=1, lease_seconds=1.0, batch=6) as samplers:
            assert until(samplers.in_a_step)
            [sleeper] = samplers.working
            samplers.signal(sleeper, signal.SIGSTOP)
            before = samplers.notes_in(sleeper).begun
            samplers.start()
            assert until(lambda: finished(api, "slept")), "others take its queries"
            [other] = samplers.working.keys() - {sleeper}
            samplers.kill(other)
            samplers.signal(sleeper, signal.SIGCONT)
            [asked] = api.add_queries("slept", [[0.5, 0.5]], [[0.0]])
            assert until(lambda: api.queries("slept")[-1].status == "answered"), "it goes on"
            assert samplers.notes_in(sleeper).begun == [*before, tuple(asked.coordinates or ())]
            assert until(lambda: not samplers.in_a_step())
        tally = Tally()
        tally.judge(api, "slept", samplers.notes(), patient=True)
