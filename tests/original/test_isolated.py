"""An environment that raises, hangs or dies costs one step, never the process that asked."""

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from functools import partial

import numpy as np
import pytest

from support.machine import DIARY, STEP_SECONDS
from support.noting import until
from surrogym_sampler import original
from surrogym_sampler.original import RealStep
from surrogym_sampler.original.errors import EnvironmentDied, StepFailed, StepTimedOut, UnknownEnvironment
from surrogym_sampler.original.isolated import IsolatedEnvironment


class Moody:
    """Action 0 works, 1 raises, 2 hangs, 3 dies, 4 exits."""

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
        if mood == 4:
            sys.exit("the licence has expired")
        if mood == 5:
            raise KeyboardInterrupt
        return RealStep(coordinates, action, coordinates, reward=float(os.getpid()))

    def close(self):
        pass


class Leaving(Moody):
    """Leaves a file when it is closed."""

    def __init__(self, file):
        self._file = file

    def close(self):
        time.sleep(0.3)
        self._file.touch()


def broken():
    raise OSError("no robot at /dev/robot")


@pytest.fixture
def moody():
    with IsolatedEnvironment(Moody, step_limit=1.0) as environment:
        environment.step_from(np.zeros(2), np.zeros(1))
        yield environment


def step(environment, mood):
    return environment.step_from(np.zeros(2), np.array([float(mood)]))


def test_an_isolated_environment_steps_in_another_process(moody):
    assert int(step(moody, 0).reward) != os.getpid()


def test_an_error_in_an_isolated_environment_fails_one_step_only(moody):
    child = step(moody, 0).reward
    with pytest.raises(StepFailed, match="RuntimeError: the motor is hot"):
        step(moody, 1)
    assert step(moody, 0).reward == child


@pytest.mark.parametrize(
    ("mood", "error"), [(2, StepTimedOut), (3, EnvironmentDied), (4, EnvironmentDied), (5, EnvironmentDied)]
)
def test_an_isolated_environment_that_hangs_or_dies_is_replaced(moody, mood, error):
    child = int(step(moody, 0).reward)
    with pytest.raises(error):
        step(moody, mood)
    assert not _alive(child)
    assert int(step(moody, 0).reward) != child


def test_an_isolated_environment_that_calls_exit_reports_the_reason_and_is_closed(tmp_path):
    """Only an exit code was reported."""
    with IsolatedEnvironment(partial(Leaving, tmp_path / "closed")) as environment:
        with pytest.raises(EnvironmentDied, match=r"during step_from: SystemExit: the licence has expired \(test_iso"):
            step(environment, 4)
        assert (tmp_path / "closed").exists()


def test_an_isolated_environment_that_raises_keyboard_interrupt_reports_the_line(moody, capfd):
    """A traceback was printed, and only an exit code reported."""
    with pytest.raises(EnvironmentDied, match=r"during step_from: KeyboardInterrupt \(test_isolated.py"):
        step(moody, 5)
    assert "Traceback" not in capfd.readouterr().err


def test_an_environment_factory_that_calls_exit_reports_the_reason():
    with (
        IsolatedEnvironment(partial(sys.exit, "no licence")) as environment,
        pytest.raises(UnknownEnvironment, match="SystemExit: no licence"),
    ):
        environment.spec()


def test_the_error_of_a_failing_environment_factory_is_reported():
    with IsolatedEnvironment(broken) as environment, pytest.raises(UnknownEnvironment, match="no robot at"):
        environment.spec()


def test_an_isolated_environment_returns_its_specification_from_the_other_process():
    with IsolatedEnvironment(partial(original.make, "Pendulum-v1", budget=9)) as environment:
        assert environment.spec() == original.make("Pendulum-v1", budget=9).spec()


def test_closing_an_isolated_environment_leaves_no_process_behind(moody):
    child = int(step(moody, 0).reward)
    moody.close()
    assert not _alive(child)


def _alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


HELD = """
import sys, time, os, signal
import numpy as np
from surrogym_sampler.original.isolated import IsolatedEnvironment
from support.machine import Deliberate

if __name__ == "__main__":
    with IsolatedEnvironment(Deliberate, step_limit=20.0) as environment:
        print(environment.spec().environment, flush=True)
        environment.step_from(np.zeros(1), np.zeros(1))
"""


def in_a_step(folder, seconds=1):
    """A process of its own, in the middle of a machine's step."""
    paths = os.pathsep.join(path for path in sys.path if path)
    environment = {**os.environ, "PYTHONPATH": paths, DIARY: str(folder / "diary"), STEP_SECONDS: str(seconds)}
    (folder / "held.py").write_text(HELD)
    process = subprocess.Popen(
        [sys.executable, str(folder / "held.py")],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    assert until(lambda: "step 0" in diary_of(folder))
    return process


def diary_of(folder):
    path = folder / "diary"
    return path.read_text().splitlines() if path.exists() else []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_if_the_user_process_is_killed_an_isolated_environment_finishes_its_step_and_closes(tmp_path, number):
    with in_a_step(tmp_path) as process:
        process.send_signal(number)
        process.wait(60)
    assert until(lambda: "closed" in diary_of(tmp_path), 60.0)
    assert diary_of(tmp_path) == ["open", "step 0", "done", "close", "closed"]


def test_a_second_interrupt_does_not_wait_for_the_running_step(tmp_path):
    with in_a_step(tmp_path, seconds=60) as process:
        for _ in range(40):
            process.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                process.wait(0.5)
                break
    assert diary_of(tmp_path) == ["open", "step 0"]


class Numbered(Moody):
    """Tells which step this is; the first takes a while."""

    steps = 0

    def step_from(self, coordinates, action):
        self.steps += 1
        time.sleep(1.0 if self.steps == 1 else 0.0)
        return RealStep(coordinates, action, coordinates, reward=float(self.steps))


def test_an_isolated_environment_interrupted_while_starting_can_be_closed(monkeypatch):
    def interrupted(_self, _pipe):
        raise KeyboardInterrupt

    monkeypatch.setattr(IsolatedEnvironment, "_await_start", interrupted)
    environment = IsolatedEnvironment(Moody, step_limit=1.0)
    with pytest.raises(KeyboardInterrupt):
        environment.step_from(np.zeros(2), np.zeros(1))
    environment.close()


def test_the_reply_to_an_interrupted_step_is_not_taken_for_another():
    with IsolatedEnvironment(Numbered) as environment:
        environment.spec()
        threading.Timer(0.3, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            step(environment, 0)
        assert step(environment, 0).reward == 2.0


def test_an_isolated_environment_that_does_not_start_in_time_is_replaced(monkeypatch):
    monkeypatch.setattr("surrogym_sampler.original.isolated.START_LIMIT", 0.0)
    with IsolatedEnvironment(Moody) as environment:
        with pytest.raises(StepTimedOut, match="to start"):
            environment.spec()
        monkeypatch.undo()
        assert environment.spec() == Moody().spec()
