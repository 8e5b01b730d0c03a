"""A server that asks for more than the person, or the environment's own specification, allows moves no machine."""

from __future__ import annotations

import math
import re
import time
import uuid

import pytest

from support.moody import SPEC, Line
from support.rail import SPEC as RAIL
from surrogym_client.errors import ProtocolMismatch
from surrogym_client.transport import Api
from surrogym_client.transport.connection import Connection
from surrogym_sampler.original.errors import QueryRefused, UnknownEnvironment
from surrogym_sampler.queries import Sampler, SamplerSettings
from surrogym_sampler.queries.query_limits import check_environment, check_query
from surrogym_shared.spec import Bounds, Coordinate, DiscreteAction, MultiDiscreteAction, Uniform
from surrogym_shared.wire import RolloutQuery, StepQuery

WIDE = (Coordinate(name="x", sampling=Uniform(low=-1, high=1), bounds=Bounds(high=3)),)
LEASE = {"id": 1, "number": 0, "purpose": "manual", "attempt": 1, "lease_token": "t", "lease_seconds": 60.0}


class Machine(Line):
    """Notes what it is driven to; a step takes ``seconds``."""

    def __init__(self, seconds=0.0):
        self.driven = []
        self.seconds = seconds

    def step_from(self, coordinates, action):
        self.driven.append((float(coordinates[0]), float(action[0])))
        time.sleep(self.seconds)
        return super().step_from(coordinates, action)


class Greedy(Connection):
    """Asks for six queries in each claim."""

    def post(self, reply, path, body=None, **options):
        if path.endswith("queries:claim"):
            body = body.model_copy(update={"max_queries": 6})
        return super().post(reply, path, body, **options)


class Forged(Api):
    """Its server changes what a claim asks for (``forge``), or gives as many queries as there are (``greedy``)."""

    def __init__(self, url, forge=None, *, greedy=False):
        super().__init__(url)
        self.forge = forge or (lambda query: query)
        if greedy:
            self.connection = Greedy(url)

    def claim(self, name, sampler, **options):
        claimed = super().claim(name, sampler, **options)
        return claimed.model_copy(update={"queries": [self.forge(query) for query in claimed.queries]})


@pytest.fixture
def line(server_process):
    name = f"line-{uuid.uuid4().hex[:8]}"
    with Api(server_process.url) as api:
        api.create_surrogate(name, SPEC)
        yield name
        api.delete_surrogate(name)


def step(coordinates, action):
    return StepQuery(**LEASE, coordinates=coordinates, action=action)


def rollout(actions):
    return RolloutQuery(**LEASE, actions=actions)


def test_a_server_that_returns_more_queries_than_requested_causes_no_real_step(server_process, line):
    machine = Machine()
    settings = SamplerSettings(max_queries=1, until_done=True, wait_seconds=5.0)
    with (
        Forged(server_process.url, greedy=True) as api,
        pytest.raises(ProtocolMismatch, match=r"at most 1 .* got 6"),
    ):
        Sampler(api, line, machine, settings).run()
    assert machine.driven == []


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (
            {"coordinates": [1e6]},
            r"coordinate 'x' of the query: expected a value in the environment's range \[-1, 1\], got 1e\+06: .*",
        ),
        (
            {"action": [500.0]},
            r"action 0 of the query: expected a value in the environment's range \[-1, 1\], got 500: .*",
        ),
        ({"coordinates": [0.0, 0.0]}, "coordinates of the query: expected 1 numbers, .* got 2: .*"),
    ],
)
def test_a_query_outside_the_environments_limits_is_refused_without_a_step(server_process, line, change, why):
    machine, told = Machine(), []

    def forge(query):
        return query.model_copy(update=change) if query.number == 0 else query

    with Forged(server_process.url, forge) as api:
        settings = SamplerSettings(batch=3, once=True, wait_seconds=5.0)
        report = Sampler(api, line, machine, settings, lambda *seen: told.append(seen)).run()
        view, [refused] = api.surrogate(line), [query.error for query in api.queries(line) if query.error]
    assert (report.answered, report.refused, len(machine.driven)) == (2, 1, 2)
    assert (view.ledger.unresolved, view.queries.leased, view.queries.pending) == (0, 0, 4)
    [(outcome, error)] = [(outcome, error) for _, outcome, error in told if error]
    assert (outcome, error) == ("refused", refused)
    assert re.fullmatch(why, error)


def test_repeatedly_refused_queries_are_reported_once(server_process, line):
    told = []
    with Forged(server_process.url, lambda query: query.model_copy(update={"action": [math.nan]})) as api:
        settings = SamplerSettings(batch=2, wait_seconds=5.0, time_limit=1.5)
        report = Sampler(api, line, Machine(), settings, lambda *seen: told.append(seen)).run()
    assert report.refused == len(told) == 2


def test_the_samplers_time_limit_is_checked_between_queries_fetched_together(server_process, line):
    machine = Machine(seconds=1.0)
    with Api(server_process.url) as api:
        Sampler(api, line, machine, SamplerSettings(batch=6, wait_seconds=5.0, time_limit=0.5)).run()
        view = api.surrogate(line)
    assert len(machine.driven) == 1
    assert (view.ledger.total, view.ledger.unresolved, view.queries.pending) == (1, 0, 5)


def test_queries_may_use_the_whole_bounds_up_to_float32_rounding():
    spec = SPEC.model_copy(update={"coordinates": WIDE})
    for x in (-1.0, -1.0 - 1e-7, 2.9, 3.0 + 2e-7):
        check_query(spec, step([x], [1.0 + 1e-7]))
    for x in (-1.1, 3.1, math.inf, math.nan):
        with pytest.raises(QueryRefused, match=r"range \[-1, 3\]"):
            check_query(spec, step([x], [0.0]))


@pytest.mark.parametrize(
    ("action", "good", "bad"),
    [
        (DiscreteAction(n=3), [2.0], [[3.0], [-1.0], [0.5], [], [0.0, 0.0]]),
        (MultiDiscreteAction(nvec=(2, 3)), [1.0, 2.0], [[2.0, 0.0], [0.0], [0.0, 1.5]]),
    ],
)
def test_a_query_with_an_invalid_discrete_action_is_refused(action, good, bad):
    spec = SPEC.model_copy(update={"action": action})
    check_query(spec, step([0.0], good))
    for numbers in bad:
        with pytest.raises(QueryRefused, match="action"):
            check_query(spec, step([0.0], numbers))


def test_all_actions_of_a_rollout_are_checked_before_its_first_step():
    check_query(RAIL, rollout([[1.0]] * 20))
    for actions, why in (([[1.0]] * 21, "1 to 20 actions, got 21"), ([], "got 0"), ([[0.0], [9.0]], "got 9")):
        with pytest.raises(QueryRefused, match=why):
            check_query(RAIL, rollout(actions))
    with pytest.raises(QueryRefused, match=r"expected a rollout query, .* got a step query"):
        check_query(RAIL, step([0.0], [0.0]))


def test_sampling_a_surrogate_with_wider_ranges_than_the_environment_is_refused():
    wide = SPEC.model_copy(update={"coordinates": (Coordinate(name="x", sampling=Uniform(low=-1, high=2)),)})
    with pytest.raises(UnknownEnvironment, match=r"expected coordinates from \[-1\] to \[1\], got \[-1\] to \[2\]"):
        check_environment("line", wide, SPEC)
    check_environment("line", wide, SPEC.model_copy(update={"coordinates": WIDE}))
