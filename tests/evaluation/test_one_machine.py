"""An original environment is one machine unless it says otherwise: one driver, one episode after the other."""

import signal
from functools import partial

import numpy as np
import pytest

from support.machine import Machine, SettableMachine, Simulator, diary_in, most_at_once, note
from surrogym_client.runtime.lifetime import terminations_as_interrupts
from surrogym_lab.original_port import NotParallel, OriginalPort
from surrogym_sampler import original
from surrogym_sampler.original.episodes import open_episode
from surrogym_sampler.original.errors import EvaluationFailed, PolicyMisfit
from surrogym_shared.wire import OpenSession
from surrogym_trainer.evaluation import EvaluationInterrupted, EvaluationSettings, evaluate

EPISODES = 3
STEPS = 20  # of an episode of these machines


@pytest.fixture
def diary(tmp_path, monkeypatch):
    with diary_in(tmp_path, monkeypatch) as path:
        yield lambda: path.read_text().splitlines()


def push(observation):
    return 0.1 * np.sign(observation)


def run(factory, policy=push, **settings):
    opener = partial(open_episode, "a machine", None, factory)
    return evaluate(policy, opener, EvaluationSettings(episodes=EPISODES, **settings))


@pytest.mark.parametrize("machine", [Machine, SettableMachine])
def test_only_one_environment_instance_is_open_at_a_time(diary, machine):
    assert run(machine).steps == EPISODES * STEPS
    assert most_at_once(diary()) == 1


def test_evaluation_episodes_on_one_machine_run_one_after_the_other(diary):
    run(Machine)
    moved = [what for what in diary() if what.startswith(("reset", "step"))]
    resets = [i for i, what in enumerate(moved) if what.startswith("reset")]
    assert [moved[i] for i in resets] == ["reset 10000", "reset 10000", "reset 10001", "reset 10002"]
    assert resets == [0, 1, STEPS + 2, 2 * (STEPS + 1) + 1]


def test_evaluation_opens_several_instances_of_an_environment_declared_parallel(diary):
    run(Simulator)
    assert most_at_once(diary()) == EPISODES


def test_evaluation_opens_several_instances_if_the_user_asks_for_them(diary):
    run(Machine, parallel=2)
    assert most_at_once(diary()) == 2


@pytest.mark.parametrize("factory", [Simulator, Machine])
def test_evaluated_returns_are_equal_in_parallel_and_in_sequence(diary, factory):
    together, apart = run(factory, parallel=EPISODES), run(factory, parallel=1)
    assert together.returns.tolist() == apart.returns.tolist()
    assert together.lengths.tolist() == apart.lengths.tolist()
    assert diary()


@pytest.mark.parametrize(
    ("name", "choices"),
    [
        ("Pendulum-v1", {}),
        ("Pendulum-v1", {"wide": True}),
        ("CartPole-v1", {"perturb": 0.3}),
        ("CartPole-v1", {"start_scale": 2.0}),
        ("InvertedPendulum-v5", {"perturb": 0.3}),
    ],
)
def test_a_reused_simulator_gives_the_same_returns_as_fresh_ones(name, choices):
    if name.endswith("v5"):
        pytest.importorskip("mujoco")
    spec = original.make(name).spec()
    opener = partial(open_episode, name, spec, partial(original.make, name))

    def policy(observation):
        pushed = np.sin(7 * observation.sum(1))
        return (pushed > 0).astype(int) if name == "CartPole-v1" else pushed[:, None]

    results = [evaluate(policy, opener, EvaluationSettings(episodes=4, parallel=n, **choices)) for n in (None, 1, 3)]
    assert results[0].returns.tolist() == results[1].returns.tolist() == results[2].returns.tolist()


def test_every_environment_instance_is_closed_although_closing_one_fails(diary):
    class Stuck(Simulator):
        def close(self):
            super().close()
            raise OSError("the port is gone")

    with pytest.raises(EvaluationFailed, match="after 60 real steps: OSError: the port is gone"):
        run(Stuck)
    assert most_at_once(diary()) == EPISODES


class Acting(Machine):
    """Does something in the middle of its third step, and notes what it has survived."""

    steps = 0

    def step(self, action):
        moved = super().step(action)
        self.steps += 1
        if self.steps == 3:
            self.act()
            note("done")
        return moved


def acting(act):
    return type("Acting", (Acting,), {"act": lambda _: act()})


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupted_evaluation_ends_after_the_step_and_closes_the_environment(diary, number):
    pressed = acting(partial(signal.raise_signal, number))
    with terminations_as_interrupts(), pytest.raises(EvaluationInterrupted) as interrupted:
        run(pressed)
    assert interrupted.value.steps == 3
    assert diary()[-2:] == ["done", "close"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_second_interrupt_ends_evaluation_within_the_step_and_closes_the_environment(diary):
    with pytest.raises(EvaluationInterrupted) as interrupted:
        run(acting(lambda: [signal.raise_signal(signal.SIGINT) for _ in range(2)]))
    assert interrupted.value.steps == 3
    assert "done" not in diary()
    assert diary()[-1] == "close"


@pytest.mark.parametrize("kind", [RuntimeError, SystemExit])
def test_an_exception_during_a_step_counts_the_step_and_closes_the_environment(diary, kind):
    """``sys.exit`` ended the command without a word, and no ledger had the steps."""

    def stall():
        raise kind("the motor has stalled")

    message = rf"after 3 real steps: {kind.__name__}: the motor has stalled"
    with pytest.raises(EvaluationFailed, match=message) as failed:
        run(acting(stall))
    assert failed.value.steps == 3
    assert diary()[-1] == "close"


def test_an_action_that_is_nan_is_not_sent_to_the_environment(diary):
    with pytest.raises(PolicyMisfit, match=r"expected finite actions, got \[\[nan\]\]"):
        run(Machine, lambda observation: np.full_like(observation, np.nan))
    assert diary() == ["open", "reset 10000", "reset 10000", "close"]


def test_an_action_beyond_its_bounds_is_clipped_before_it_is_sent(diary):
    run(Machine, lambda observation: np.full_like(observation, -7.0))
    assert "step -1" in diary()
    assert "step -7" not in diary()


def test_an_episode_ended_by_the_environment_is_not_stepped_further(diary):
    class Ends(Machine):
        def step(self, action):
            observation, reward, terminated, _, info = super().step(action)
            return observation, reward, terminated, True, info

    assert run(Ends).lengths.tolist() == [1] * EPISODES


def test_a_nan_observation_ends_the_evaluation(diary):
    class Blind(Machine):
        def coordinates(self, observation):
            return observation[:1] if self.x == 0 else observation[:1] * np.nan

        def reset(self, *, seed=None):
            _, info = super().reset(seed=seed)
            self.x = 0.0
            return np.zeros(2), info

    with pytest.raises(EvaluationFailed, match="to give 1 finite coordinates and a finite reward"):
        run(Blind, lambda observation: np.ones_like(observation))
    assert diary()[-2:] == ["step 1", "close"]


def test_training_in_the_original_environment_uses_one_instance(diary):
    port = OriginalPort(Machine.spec(None), partial(open_episode, "a machine", None, Machine))
    with pytest.raises(NotParallel, match="expected one lane in one session"):
        port.open(OpenSession(num_envs=2, autoreset_mode="same_step"))
    session = port.open(OpenSession(num_envs=1, autoreset_mode="same_step")).id
    with pytest.raises(NotParallel, match="expected one lane in one session"):
        port.open(OpenSession(num_envs=1, autoreset_mode="same_step"))
    port.reset(session)
    port.step(session, np.zeros((1, 1)))
    port.close(session)
    assert most_at_once(diary()) == 1
