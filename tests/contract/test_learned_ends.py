"""A declared reward and a learned termination, registered over HTTP, are the same on every transport and in process;
so is what a policy of discrete choices does there."""

from collections.abc import Iterator

import numpy as np
import pytest

from support.acting import assert_same_rollout, random_policy, stepped
from support.teaching import teach
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_sampler.original.classic import cartpole
from surrogym_server.convert import definition_from_spec
from surrogym_server.local import LocalSurrogate
from surrogym_server.models.files import from_bytes
from surrogym_shared.acting import Actor, NoiseKey
from surrogym_shared.port import PolicyPort
from surrogym_shared.spec import DeclaredReward, Quantity, RewardTerm, Term
from surrogym_shared.wire import OpenSession

NAME = "learned-ends"
DISTANCE = RewardTerm(weight=-1.0, shape="absolute", of=(Quantity(term=Term.linear(pole=1)),))
SPEC = cartpole().model_copy(
    update={
        "termination": "learned",
        "reward": DeclaredReward(kind="declared", timing="after", terms=(DISTANCE,), terminal=-5.0),
    }
)


@pytest.fixture(scope="module")
def ports(pendulum_server) -> Iterator[dict[str, PolicyPort]]:
    with Api(pendulum_server.url) as api:
        teach(api, NAME, SPEC, queries=40)
        stored = api.surrogate(NAME).spec
        model = from_bytes(definition_from_spec(stored), api.export_model(NAME, 1))
    assert stored.termination == "learned"
    assert isinstance(stored.reward, DeclaredReward)
    with (
        HttpSurrogate(pendulum_server.url, NAME, transport="json") as json,
        HttpSurrogate(pendulum_server.url, NAME, transport="binary") as binary,
        HttpSurrogate(pendulum_server.url, NAME, transport="stream") as stream,
    ):
        yield {"local": LocalSurrogate(stored, model), "json": json, "binary": binary, "stream": stream}


def test_learned_termination_and_declared_reward_are_equal_over_every_transport(ports):
    told = {}
    for name, port in ports.items():
        session = port.open(OpenSession(num_envs=4, seed=3, autoreset_mode="same_step")).id
        port.reset(session)
        told[name] = [port.step(session, np.ones(4, dtype=np.int64)) for _ in range(30)]
        port.close(session)
    rewards = {name: np.stack([step.reward for step in steps]) for name, steps in told.items()}
    ends = {name: np.stack([step.terminated for step in steps]) for name, steps in told.items()}
    assert ends["local"].any(), "a cart that is pushed one way drops its pole"
    assert (rewards["local"][ends["local"]] < -5).all()
    assert (np.abs(rewards["local"][~ends["local"]]) < 0.3).all()
    for name in ("json", "binary", "stream"):
        np.testing.assert_array_equal(rewards[name], rewards["local"])
        np.testing.assert_array_equal(ends[name], ends["local"])


def test_the_set_points_of_a_session_are_equal_over_every_transport(ports):
    told = {}
    for name, port in ports.items():
        session = port.open(OpenSession(num_envs=4, seed=3, set_points={"pole": 0.05})).id
        port.reset(session)
        told[name] = [port.step(session, np.ones(4, dtype=np.int64)) for _ in range(5)]
        port.close(session)
        with pytest.raises(Exception, match="expected a number in the sampling range"):
            port.open(OpenSession(set_points={"pole": 9.0}))
    pole = ports["local"].spec().observation_names.index("pole")
    for steps in told.values():
        for step, same in zip(steps, told["local"], strict=True):
            np.testing.assert_array_equal(step.reward, same.reward)
            assert not step.terminated.any()
            np.testing.assert_allclose(step.reward, -np.abs(step.observation[:, pole] - 0.05), atol=1e-6)


@pytest.mark.parametrize("noise", [None, NoiseKey(5)], ids=["most probable", "noisy"])
def test_a_discrete_policy_rollout_equals_single_steps_over_every_transport(ports, noise):
    policy = random_policy((4, 12, 2), continuous=False)
    actor = Actor(policy, 4, np.zeros(0), np.zeros(0), (2,), noisy=noise is not None)
    opening = OpenSession(num_envs=6, seed=3, autoreset_mode="same_step")
    single = ports["local"].open(opening).id
    start = ports["local"].reset(single).observation
    expected = stepped(ports["local"], single, actor, start, 40, noise)
    assert len(expected.final_lanes), "poles fall"
    assert noise is None or set(np.unique(expected.action)) == {0.0, 1.0}
    for port in ports.values():
        session = port.open(opening).id
        port.reset(session)
        assert_same_rollout(port.rollout_policy(session, policy, 40, noise=noise), expected)
        port.close(session)
