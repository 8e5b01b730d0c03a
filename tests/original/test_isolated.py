"""An environment that raises, hangs or dies costs one step, never the process that asked."""

import os
import time
from functools import partial

import numpy as np
import pytest

from surrogym_client import original
from surrogym_client.original import RealStep
from surrogym_client.original.errors import EnvironmentDied, StepFailed, StepTimedOut, UnknownEnvironment
from surrogym_client.original.isolated import IsolatedEnvironment


class Moody:
    """Action 0 works, 1 raises, 2 hangs, 3 dies."""

    def spec(self):
        return original.make("Pendulum-v1").spec()

    def step_from(self, coordinates, action):
        mood = int(action[0])
        if mood == 1:
            raise RuntimeError("the motor is hot")
        if mood == 2:
            time.sleep(3600)
        if mood == 3:
            os._exit(7)
        return RealStep(coordinates, action, coordinates, reward=float(os.getpid()))

    def close(self):
        pass


def broken():
    raise OSError("no robot at /dev/robot")


@pytest.fixture
def moody():
    with IsolatedEnvironment(Moody, step_limit=1.0) as environment:
        environment.step_from(np.zeros(2), np.zeros(1))
        yield environment


def step(environment, mood):
    return environment.step_from(np.zeros(2), np.array([float(mood)]))


def test_a_step_runs_in_another_process(moody):
    assert int(step(moody, 0).reward) != os.getpid()


def test_one_that_raises_is_reported_and_goes_on(moody):
    child = step(moody, 0).reward
    with pytest.raises(StepFailed, match="RuntimeError: the motor is hot"):
        step(moody, 1)
    assert step(moody, 0).reward == child


@pytest.mark.parametrize(("mood", "error"), [(2, StepTimedOut), (3, EnvironmentDied)])
def test_one_that_hangs_or_dies_is_replaced(moody, mood, error):
    child = int(step(moody, 0).reward)
    with pytest.raises(error):
        step(moody, mood)
    assert not _alive(child)
    assert int(step(moody, 0).reward) != child


def test_a_factory_that_fails_says_why():
    with IsolatedEnvironment(broken) as environment, pytest.raises(UnknownEnvironment, match="no robot at"):
        environment.spec()


def test_the_specification_crosses_the_process():
    with IsolatedEnvironment(partial(original.make, "Pendulum-v1", budget=9)) as environment:
        assert environment.spec() == original.make("Pendulum-v1", budget=9).spec()


def test_close_leaves_no_process_behind(moody):
    child = int(step(moody, 0).reward)
    moody.close()
    assert not _alive(child)


def _alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True
