"""Test functions for implementations of ``SessionEngine``. The laws are in its docstring in ``engine.port``."""

from __future__ import annotations

import asyncio
import pickle
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from surrogym_server.engine.port import SessionEngine
from surrogym_server.engine.requests import Advance, Open, Opening, PolicySteps, Reply, Reset, Restore, Rollout, Step
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import (
    DeadlineExceeded,
    IdempotencyConflict,
    InvalidInput,
    NotReset,
    SeqConflict,
    SurrogymError,
    UnknownModel,
    UnknownSession,
)
from surrogym_server.virtual import VirtualSettings
from surrogym_shared.acting import ActingPolicy, NoiseKey, PolicyRun
from surrogym_shared.network import Layer
from surrogym_shared.port import PolicyRollout

LANES, STEPS, SEED = 3, 12, 7
E = TypeVar("E", bound=SurrogymError)


@dataclass(frozen=True)
class EngineCase:
    """A test case of an engine: the started engine, and a surrogate with one continuous action and a model of version
    1."""

    engine: SessionEngine
    surrogate: str
    surrogate_id: int
    definition: EnvironmentDefinition

    def asked(
        self, *, key: str | None = None, seed: int | None = SEED, occupancy: bool = False, **settings: Any
    ) -> Open:
        """Return a request to open a session of the surrogate. ``settings`` are fields of ``VirtualSettings``."""
        chosen: dict[str, Any] = {"num_envs": LANES, "autoreset_mode": "same_step", "time_limit": 5} | settings
        opening = Opening(VirtualSettings(**chosen), None, seed, "latest", occupancy, key)
        return Open(self.surrogate, self.surrogate_id, self.definition, opening)

    async def opened(self, **options: Any) -> str:
        """Open a session with the ``options`` of ``asked``, reset it, and return its id."""
        session = (await self.engine.open(self.asked(**options))).id
        await self.engine.advance(Reset(session, 1))
        return session

    def action(self, number: int = 0) -> NDArray[np.float64]:
        """Return random actions (N, 1) within their bounds; ``number`` is the seed."""
        low, high = self.definition.action_limits
        share: NDArray[np.float64] = np.random.default_rng(number).uniform(0.1, 0.9, (LANES, 1))
        return low + share * (high - low)

    def steps(self, session: str, count: int = STEPS) -> list[Advance]:
        """Return requests for ``count`` steps of a session that has just been reset."""
        return [Step(session, number + 2, self.action(number)) for number in range(count)]

    def policy(self, session: str, seq: int) -> PolicySteps:
        """Return a request for a rollout with a random policy that acts with noise."""
        observation, rng = len(self.definition.observation_names), np.random.default_rng(0)
        layer = Layer(rng.normal(size=(observation, 1)), np.zeros(1))
        policy = ActingPolicy(np.zeros(observation), np.ones(observation), (layer,), log_deviations=np.zeros(1))
        return PolicySteps(session, seq, PolicyRun(policy, STEPS, NoiseKey(3, 0)))


Law = Callable[[EngineCase], Awaitable[None]]


async def an_opening_again_under_its_key_gives_the_same_session(case: EngineCase) -> None:
    first = await case.engine.open(case.asked(key="once"))
    again = await case.engine.open(case.asked(key="once"))
    assert first.id == again.id
    await _refused(IdempotencyConflict, case.engine.open(case.asked(key="once", penalty=1.0)))
    other = await case.engine.open(case.asked(key="other"))
    assert other.id != first.id


async def a_session_says_how_it_was_opened(case: EngineCase) -> None:
    info = await case.engine.open(case.asked())
    assert (info.surrogate, info.surrogate_id, info.seed, info.seq) == (case.surrogate, case.surrogate_id, SEED, 0)
    assert (info.settings.num_envs, info.versions.tolist()) == (LANES, [1] * LANES)
    await case.engine.advance(Reset(info.id, 1))
    assert (await case.engine.describe(info.id)).seq == 1
    assert (await case.engine.coordinates(info.id)).shape == (LANES, len(case.definition.coordinates))


async def a_model_there_is_none_of_is_refused(case: EngineCase) -> None:
    asked = case.asked()
    await _refused(UnknownModel, case.engine.open(replace(asked, opening=replace(asked.opening, model=99))))


async def a_repeat_gets_the_same_reply_and_is_carried_out_once(case: EngineCase) -> None:
    session, twin = await case.opened(), await case.opened()
    for request, other in zip(case.steps(session), case.steps(twin), strict=True):
        first = await case.engine.advance(request)
        _require_same(await case.engine.advance(request), first)
        _require_same(await case.engine.advance(other), first)


async def repeats_at_once_get_one_reply(case: EngineCase) -> None:
    session, twin = await case.opened(), await case.opened()
    first, *others = await asyncio.gather(*(case.engine.advance(case.policy(session, 2)) for _ in range(3)))
    for other in others:
        _require_same(other, first)
    _require_same(await case.engine.advance(case.policy(twin, 2)), first)


async def any_other_seq_or_body_is_refused_and_the_expected_seq_named(case: EngineCase) -> None:
    session = await case.opened()
    await case.engine.advance(Step(session, 2, case.action(0)))
    for wrong in (Step(session, 2, case.action(1)), Step(session, 1, case.action(0)), Step(session, 9, case.action(0))):
        refused = await _refused(SeqConflict, case.engine.advance(wrong))
        assert refused.expected == 3
        assert pickle.loads(pickle.dumps(refused)).expected == 3


async def a_refused_request_takes_no_seq_and_changes_nothing(case: EngineCase) -> None:
    session, twin = await case.opened(), await case.opened()
    many, far = np.zeros((LANES + 1, 1)), np.full((LANES, 1), 1e9)
    for bad in (many, far, np.full((LANES, 1), np.nan)):
        await _refused(InvalidInput, case.engine.advance(Step(session, 2, bad)))
        actions = np.stack([case.action(), bad]) if len(bad) == LANES else np.zeros((2, LANES + 1, 1))
        await _refused(InvalidInput, case.engine.advance(Rollout(session, 2, actions)))
    await _refused(InvalidInput, case.engine.advance(Reset(session, 2, mask=np.ones(LANES + 1, dtype=bool))))
    good = Step(session, 2, case.action())
    _require_same(await case.engine.advance(good), await case.engine.advance(replace(good, session=twin)))


async def a_lane_that_was_never_reset_is_not_stepped(case: EngineCase) -> None:
    session = (await case.engine.open(case.asked())).id
    await _refused(NotReset, case.engine.advance(Step(session, 1, case.action())))
    assert (await case.engine.advance(Reset(session, 1))).seq == 1


async def replies_depend_on_seed_and_requests_alone(case: EngineCase) -> None:
    sessions = [await case.opened(seed=seed) for seed in (SEED, SEED, SEED + 1)]
    replies = [[await case.engine.advance(r) for r in case.steps(session)] for session in sessions]
    for first, second in zip(replies[0], replies[1], strict=True):
        _require_same(second, first)
    assert not _same(replies[2][0], replies[0][0]), "another seed, another start"


async def a_rollout_is_its_steps(case: EngineCase) -> None:
    session, twin = await case.opened(), await case.opened()
    single = [await case.engine.advance(request) for request in case.steps(session)]
    actions = np.stack([case.action(number) for number in range(STEPS)])
    rolled = await case.engine.advance(Rollout(twin, 2, actions))
    assert rolled.seq == 2
    assert isinstance(rolled.outcome, tuple)
    for t, reply in enumerate(single):
        assert isinstance(reply.outcome, tuple)
        _require_same(Reply(0, (rolled.outcome[t],)), Reply(0, reply.outcome))


async def a_policy_acts_as_often_as_it_is_asked_to(case: EngineCase) -> None:
    session = await case.opened()
    reply = await case.engine.advance(case.policy(session, 2))
    assert isinstance(reply.outcome, PolicyRollout)
    assert (len(reply.outcome), reply.seq) == (STEPS, 2)


async def lanes_outside_the_mask_stay_as_they_are(case: EngineCase) -> None:
    session = await case.opened()
    before, mask = await case.engine.coordinates(session), np.arange(LANES) == 1
    await case.engine.advance(Step(session, 2, case.action(), mask))
    after = await case.engine.coordinates(session)
    assert (before[~mask] == after[~mask]).all()
    assert (before[mask] != after[mask]).any()


async def what_would_be_late_is_refused_and_not_begun(case: EngineCase) -> None:
    session, twin = await case.opened(), await case.opened()
    await _refused(DeadlineExceeded, case.engine.advance(Step(session, 2, case.action(), within=-1.0)))
    in_time = await case.engine.advance(Step(session, 2, case.action(), within=3_600.0))
    _require_same(await case.engine.advance(Step(twin, 2, case.action())), in_time)
    kept = await case.engine.advance(Step(session, 2, case.action(), within=-1.0))
    _require_same(kept, in_time)


async def an_answer_at_once_is_the_answer(case: EngineCase) -> None:
    session, twin = await case.opened(), await case.opened()
    for request, other in zip(case.steps(session), case.steps(twin), strict=True):
        at_once = case.engine.try_now(request)
        expected = await case.engine.advance(other)
        _require_same(await case.engine.advance(request) if at_once is None else at_once, expected)


async def a_session_that_was_closed_is_unknown(case: EngineCase) -> None:
    session = await case.opened()
    await case.engine.close(session)
    await case.engine.close(session)
    await case.engine.close("never")
    for asked in (case.engine.advance(Reset(session, 2)), case.engine.describe(session), case.engine.submit("never")):
        await _refused(UnknownSession, asked)


async def a_saved_session_goes_on_as_if_nothing_had_happened(case: EngineCase) -> None:
    session, twin = await case.opened(occupancy=True), await case.opened(occupancy=True)
    for requests in (case.steps(session, 3), case.steps(twin, 3)):
        replies = [await case.engine.advance(request) for request in requests]
    [saved] = [one for one in await case.engine.save() if one.id == session]
    await case.engine.close(session)
    await case.engine.restore(pickle.loads(pickle.dumps(Restore(saved, case.surrogate_id, case.definition))))
    _require_same(await case.engine.advance(case.steps(session, 3)[2]), replies[2])
    for request, other in zip(case.steps(session)[3:], case.steps(twin)[3:], strict=True):
        _require_same(await case.engine.advance(request), await case.engine.advance(other))
    assert (await case.engine.submit(session)).states.tolist() == (await case.engine.submit(twin)).states.tolist()


async def visited_states_are_kept_where_they_are_asked_for(case: EngineCase) -> None:
    plain, fresh = await case.opened(), (await case.engine.open(case.asked(occupancy=True))).id
    await _refused(InvalidInput, case.engine.submit(plain))
    await _refused(NotReset, case.engine.submit(fresh))
    await case.engine.advance(Reset(fresh, 1))
    for request in case.steps(fresh, 4):
        await case.engine.advance(request)
    visited = await case.engine.submit(fresh)
    assert visited.surrogate_id == case.surrogate_id
    assert visited.states.shape == (5 * LANES, len(case.definition.coordinates))
    assert 0 <= visited.confidence_index <= 1


async def what_sessions_do_is_counted_once(case: EngineCase) -> None:
    before, session = case.engine.counts(), await case.opened()
    for request in case.steps(session, 4):
        await case.engine.advance(request)
    now, [did] = case.engine.counts(), await _activity(case, session)
    assert now.sessions[case.surrogate] == before.sessions.get(case.surrogate, 0) + 1
    assert (now.lanes - before.lanes, now.lane_steps - before.lane_steps) == (LANES, 4 * LANES)
    assert (did.steps, did.session.seq) == (4 * LANES, 5)
    await case.engine.advance(case.steps(session, 4)[3])
    [again] = await _activity(case, session)
    assert again.steps == did.steps, "a repeat is no step"


async def a_surrogate_that_is_forgotten_has_no_sessions(case: EngineCase) -> None:
    session = await case.opened()
    await case.engine.forget(case.surrogate_id + 1_000)
    await case.engine.describe(session)
    await case.engine.forget(case.surrogate_id)
    await _refused(UnknownSession, case.engine.describe(session))


async def requests_and_replies_pickle(case: EngineCase) -> None:
    twin = await case.opened()
    info = await case.engine.open(pickle.loads(pickle.dumps(case.asked())))
    assert pickle.loads(pickle.dumps(info)).definition == info.definition
    for request in (Reset(info.id, 1), *case.steps(info.id, 2), case.policy(info.id, 4)):
        reply = await case.engine.advance(pickle.loads(pickle.dumps(request)))
        _require_same(pickle.loads(pickle.dumps(reply)), reply)
        if request.seq != 1:
            _require_same(await case.engine.advance(replace(request, session=twin)), reply)


LAWS_OF_ENGINES: tuple[Law, ...] = (
    an_opening_again_under_its_key_gives_the_same_session,
    a_session_says_how_it_was_opened,
    a_model_there_is_none_of_is_refused,
    a_repeat_gets_the_same_reply_and_is_carried_out_once,
    repeats_at_once_get_one_reply,
    any_other_seq_or_body_is_refused_and_the_expected_seq_named,
    a_refused_request_takes_no_seq_and_changes_nothing,
    a_lane_that_was_never_reset_is_not_stepped,
    replies_depend_on_seed_and_requests_alone,
    a_rollout_is_its_steps,
    a_policy_acts_as_often_as_it_is_asked_to,
    lanes_outside_the_mask_stay_as_they_are,
    what_would_be_late_is_refused_and_not_begun,
    an_answer_at_once_is_the_answer,
    a_session_that_was_closed_is_unknown,
    a_saved_session_goes_on_as_if_nothing_had_happened,
    visited_states_are_kept_where_they_are_asked_for,
    what_sessions_do_is_counted_once,
    a_surrogate_that_is_forgotten_has_no_sessions,
    requests_and_replies_pickle,
)


async def _refused(kind: type[E], asked: Awaitable[object]) -> E:
    """Check that a request raises an error of this class that can be pickled, and return the error."""
    caught: E | None = None
    try:
        await asked
    except kind as error:
        caught = error
    assert caught is not None, f"expected {kind.__name__}"
    again = pickle.loads(pickle.dumps(caught))
    assert (type(again), str(again)) == (type(caught), str(caught))
    return caught


async def _activity(case: EngineCase, session: str) -> list[Any]:
    return [one for one in await case.engine.activity(case.surrogate) if one.session.id == session]


def _require_same(reply: Reply, expected: Reply) -> None:
    assert _same(reply, expected), "expected the same reply, bit for bit"


def _same(reply: Reply, other: Reply) -> bool:
    ours, theirs = _arrays(reply), _arrays(other)
    return reply.seq == other.seq and len(ours) == len(theirs) and all(map(_equal, ours, theirs))


def _arrays(reply: Reply) -> list[Any]:
    results: tuple[Any, ...] = reply.outcome if isinstance(reply.outcome, tuple) else (reply.outcome,)
    return [getattr(result, field.name) for result in results for field in fields(result)]


def _equal(first: Any, second: Any) -> bool:
    if first is None or second is None:
        return first is second
    return bool(first.dtype == second.dtype and first.shape == second.shape and (first == second).all())
