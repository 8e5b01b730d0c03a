"""The unseen tasks are valid environments. Nothing is learned of them here, nor anywhere before the study."""

import numpy as np
import pytest

from surrogym.demo.judging import episodes_of
from surrogym.demo.tasks import TASKS
from surrogym_lab.settings import StudySettings
from surrogym_lab.tasks import UNSEEN
from surrogym_lab.unseen.machine import Machine
from surrogym_lab.unseen.tasks import NoisySensors, ResetOnly
from surrogym_sampler.original import make
from surrogym_sampler.original.protocol import OriginalEnvironment, RolloutEnvironment, runs_in_parallel
from surrogym_sampler.original.rollouts import answering
from surrogym_server.convert import definition_from_spec
from surrogym_trainer.evaluation.evaluator import EvaluationSettings, evaluate

SETTABLE = [name for name in UNSEEN if name != "reset-only"]


def test_there_are_ten_unseen_tasks_and_none_is_a_demo_task():
    assert len(UNSEEN) == 10
    assert not set(UNSEEN) & set(TASKS)


@pytest.mark.parametrize("task", UNSEEN)
def test_each_unseen_task_has_a_specification_that_the_server_accepts(task):
    settings = StudySettings(task, seed=3)
    environment = make(settings.demo_task.environment)
    definition_from_spec(settings.spec())
    assert runs_in_parallel(environment)
    assert isinstance(environment, OriginalEnvironment | RolloutEnvironment)
    assert settings.spec().design.seed == 3
    environment.close()


@pytest.mark.parametrize("task", SETTABLE)
def test_steps_of_unseen_tasks_are_finite_and_depend_on_the_action(task):
    machine = make(UNSEEN[task].environment)
    assert isinstance(machine, Machine)
    rng = np.random.default_rng(0)
    low, high = np.array(list(machine.ranges.values())).T
    q, u = rng.uniform(low, high, (200, len(low))), rng.uniform(-1, 1, (200, machine.actions))
    after, reward = machine.formula(q, u)
    assert np.isfinite(after).all()
    assert np.isfinite(reward).all()
    assert after.shape == q.shape
    assert reward.shape == (200,)
    assert not np.allclose(machine.formula(q, -u)[0], after)
    step = machine.step_from(q[0], u[0])
    assert np.shape(step.next_coordinates) == q[0].shape
    assert not step.terminated


@pytest.mark.parametrize("task", SETTABLE)
def test_start_states_of_unseen_tasks_lie_within_the_sampling_ranges(task):
    machine = make(UNSEEN[task].environment)
    assert isinstance(machine, Machine)
    assert set(machine.start) == set(machine.ranges)
    for name, (low, high) in machine.start.items():
        assert machine.ranges[name][0] <= low < high <= machine.ranges[name][1]


def test_the_noise_of_unseen_tasks_has_its_declared_size_and_differs_between_instances():
    first, second = NoisySensors(), NoisySensors()
    q, u = np.array([0.5, 0.0]), np.zeros(1)
    seen = np.array([first.step_from(q, u).next_coordinates for _ in range(2_000)])
    assert seen.std(0) == pytest.approx([0.04, 0.08], rel=0.1)
    assert not np.allclose(first.step_from(q, u).next_coordinates, second.step_from(q, u).next_coordinates)


def test_reset_only_unseen_tasks_repeat_a_seeded_episode():
    machine = answering(ResetOnly())
    assert machine.spec().query == "rollout"
    ways = []
    for _ in range(2):
        machine.begin(5)
        ways.append([machine.act(np.array([0.3])).next_coordinates for _ in range(4)])
    np.testing.assert_array_equal(*ways)


@pytest.mark.parametrize("task", UNSEEN)
def test_an_episode_of_each_unseen_task_can_be_evaluated(task):
    settings = StudySettings(task, episodes=2)
    idle = evaluate(
        lambda o: np.zeros((len(o), settings.spec().action.size)), episodes_of(settings), EvaluationSettings(episodes=2)
    )
    assert len(np.unique(idle.returns)) == 2, "each has a start of its own"
    assert (idle.lengths == settings.spec().time_limit).all()
