"""The guard of an environment with limits: no action leaves them, and without an action the fallback acts."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from support.limited import DIARY, RAIL, SPEC, Cart, FreeCart, LateCart, NamedCart, PatientCart, SlowCart, with_limits
from support.noting import until
from surrogym_sampler.original.episodes import open_episode
from surrogym_sampler.original.errors import (
    EnvironmentDied,
    FallbackFailed,
    StepFailed,
    StepRefused,
    StepTimedOut,
    UnknownEnvironment,
)
from surrogym_sampler.original.isolated import IsolatedEnvironment
from surrogym_sampler.original.limits import Guard, GuardedRollouts, GuardedSteps
from surrogym_sampler.original.protocol import RealStep
from surrogym_sampler.original.rollouts import answering, keeping_limits
from surrogym_shared.limits import past
from surrogym_shared.spec import Limits, Term

RIGHT = np.array([1.0])
KILLED = """
import sys, time
import numpy as np
from support.limited import Cart
from surrogym_sampler.original.isolated import IsolatedEnvironment

if __name__ == "__main__":
    environment = IsolatedEnvironment(Cart)
    environment.begin(0)
    for _ in range(3):
        environment.act(np.array([1.0]))
    print("moving", flush=True)
    time.sleep(60 if sys.argv[1] == "wait" else 0)
    environment.close()
"""

SLOW = """
import sys, time
import numpy as np
from support.limited import SlowCart
from surrogym_sampler.original import isolated

def pressed(*_):
    raise KeyboardInterrupt

if __name__ == "__main__":
    isolated.CLOSE_LIMIT = 0.1
    environment = isolated.IsolatedEnvironment(SlowCart, step_limit=0.2)
    environment.begin(0)
    for _ in range(3):
        environment.act(np.array([1.0]))
    print(environment._process.pid, flush=True)
    if sys.argv[1] == "SIGTERM twice":
        environment._process.join(20)
    if sys.argv[1] == "Ctrl-C":
        environment._call = pressed
    try:
        environment.close()
    except KeyboardInterrupt:
        pass
"""


@pytest.fixture
def diary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(DIARY, str(tmp_path / "diary"))
    return tmp_path / "diary"


@pytest.fixture
def cart() -> Iterator[GuardedRollouts]:
    """A cart that does not wait for its actions."""
    environment = keeping_limits(answering(Cart()))
    assert isinstance(environment, GuardedRollouts)
    yield environment
    environment.close()


def pushed(environment: GuardedRollouts, steps: int, action: np.ndarray = RIGHT) -> list[RealStep]:
    environment.begin(0)
    return [environment.act(action) for _ in range(steps)]


def states(diary: Path) -> np.ndarray:
    """Action, position and speed of each noted step."""
    rows = [line.split() for line in diary.read_text().splitlines() if line != "close"]
    return np.array(rows, dtype=np.float64).reshape(-1, 3)


def test_no_action_can_drive_the_guarded_cart_beyond_its_declared_limit() -> None:
    free = answering(Cart(with_limits(None)))
    free.begin(0)  # type: ignore[union-attr]
    reached = [free.act(RIGHT).next_coordinates for _ in range(30)]  # type: ignore[union-attr]
    assert past(SPEC, np.array(reached)).any()
    assert np.abs(np.array(reached)[:, 0]).max() > 1
    guarded = keeping_limits(answering(PatientCart()))
    assert isinstance(guarded, GuardedRollouts)
    for action in (RIGHT, -RIGHT):
        steps = pushed(guarded, 30, action)
        assert not past(SPEC, np.array([step.next_coordinates for step in steps])).any()


def test_a_step_replaced_by_the_safety_fallback_records_the_action_applied() -> None:
    guarded = keeping_limits(answering(PatientCart()))
    assert isinstance(guarded, GuardedRollouts)
    steps = pushed(guarded, 30)
    replaced = [step for step in steps if np.asarray(step.action)[0] != 1.0]
    assert 0 < len(replaced) < len(steps)
    for step in replaced:
        x, v = np.asarray(step.coordinates)
        assert np.asarray(step.action)[0] == pytest.approx(np.clip(-0.5 * x - 1.6 * v, -1, 1))


def test_if_no_action_arrives_for_a_period_the_safety_fallback_stops_the_cart(
    cart: GuardedRollouts, diary: Path
) -> None:
    pushed(cart, 3)
    assert until(lambda: len(states(diary)) > 3 and abs(states(diary)[-1, 2]) < 0.1)
    with pytest.raises(StepFailed, match="no action came"):
        cart.act(RIGHT)
    cart.begin(1)
    assert np.asarray(cart.act(RIGHT).action)[0] == 1.0


def test_a_simulator_waits_for_actions_instead_of_using_the_safety_fallback(diary: Path) -> None:
    simulator = keeping_limits(answering(PatientCart()))
    assert isinstance(simulator, GuardedRollouts)
    pushed(simulator, 3)
    time.sleep(3 * (SPEC.sampling_period or 0))
    assert len(states(diary)) == 3
    simulator.act(RIGHT)


def test_the_safety_fallback_stops_the_machine_before_the_environment_closes(
    cart: GuardedRollouts, diary: Path
) -> None:
    pushed(cart, 3)
    cart.close()
    lines = diary.read_text().splitlines()
    assert lines[-1] == "close"
    assert len(lines) > 4
    assert abs(states(diary)[-1, 2]) < 0.1


@pytest.mark.parametrize("ends", ["kill", "term", "close"])
def test_the_safety_fallback_stops_the_machine_if_the_sampler_ends_or_is_killed(
    tmp_path: Path, diary: Path, ends: str
) -> None:
    program = tmp_path / "program.py"
    program.write_text(KILLED)
    path = os.pathsep.join(map(str, ("tests", os.environ.get("PYTHONPATH", ""))))
    with subprocess.Popen(
        [sys.executable, str(program), "end" if ends == "close" else "wait"],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    ) as child:
        assert child.stdout is not None
        assert child.stdout.readline().strip() == "moving"
        if ends != "close":
            child.send_signal(signal.SIGKILL if ends == "kill" else signal.SIGTERM)
        child.wait()
    assert until(lambda: diary.read_text().endswith("close\n"))
    assert len(states(diary)) > 3
    assert abs(states(diary)[-1, 2]) < 0.1


class Faulty(Cart):
    """A cart that raises an error in some of its steps, by number from 1."""

    def __init__(self, faults: dict[int, BaseException]) -> None:
        super().__init__()
        self._faults, self._number = faults, 0

    def step(self, action):
        self._number += 1
        if self._number in self._faults:
            raise self._faults[self._number]
        return super().step(action)


def more_than(diary: Path, steps: int) -> bool:
    return len(states(diary)) > steps


def at_rest(diary: Path) -> bool:
    return abs(states(diary)[-1, 2]) < 0.1


@pytest.mark.parametrize("fault", [OSError("no byte came"), StepRefused("not now"), SystemExit(3)])
def test_the_safety_fallback_stops_the_cart_after_a_step_that_failed(diary: Path, fault: BaseException) -> None:
    faulty = keeping_limits(answering(Faulty({4: fault})))
    assert isinstance(faulty, GuardedRollouts)
    with pytest.raises(type(fault)):
        pushed(faulty, 4)
    assert until(lambda: at_rest(diary))
    with pytest.raises(StepFailed):
        faulty.act(RIGHT)
    faulty.close()


def test_the_safety_fallback_stops_the_cart_after_a_step_of_an_episode_that_failed(diary: Path) -> None:
    episode = open_episode("cart:Faulty", None, lambda: Faulty({4: OSError("no byte came")}))
    episode.reset(0)
    for _ in range(3):
        episode.step(RIGHT)
    with pytest.raises(OSError, match="no byte"):
        episode.step(RIGHT)
    episode.close()
    assert at_rest(diary)


def test_the_safety_fallback_continues_after_an_error_in_one_of_its_steps(diary: Path) -> None:
    faulty = keeping_limits(answering(Faulty({4: OSError("no byte came"), 5: StepRefused("not now")})))
    assert isinstance(faulty, GuardedRollouts)
    pushed(faulty, 3)
    assert until(lambda: at_rest(diary))
    faulty.close()
    assert diary.read_text().endswith("close\n")


def test_a_safety_fallback_that_keeps_failing_asks_to_stop_the_machine_by_hand(
    diary: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    faulty = keeping_limits(answering(Faulty(dict.fromkeys(range(4, 20), OSError("no byte came")))))
    assert isinstance(faulty, GuardedRollouts)
    pushed(faulty, 3)
    said = "the fallback failed, so the machine may still move: stop it by hand: OSError: no byte came"
    assert until(lambda: said in capsys.readouterr().err)
    for go_on in (partial(faulty.act, RIGHT), faulty.begin):
        with pytest.raises(FallbackFailed, match=said):
            go_on()
    faulty.close()


def test_the_safety_fallback_acts_after_a_coordinate_that_was_not_measured() -> None:
    class Blind(PatientCart):
        blind = False

        def coordinates(self, observation):
            return np.array([np.nan, observation[1]]) if self.blind else observation

    cart, gently = Blind(), np.array([0.2])
    guarded = keeping_limits(answering(cart))
    assert isinstance(guarded, GuardedRollouts)
    pushed(guarded, 2, gently)
    x = cart.x
    cart.blind = True
    assert np.asarray(guarded.act(gently).action)[0] == pytest.approx(0.2)
    cart.blind = False
    fallback = np.clip(-0.5 * x - 1.6 * cart.v, -1, 1)
    assert np.asarray(guarded.act(gently).action)[0] == pytest.approx(fallback)
    assert np.asarray(guarded.act(gently).action)[0] == pytest.approx(0.2)


def test_a_reset_does_not_wait_until_the_safety_fallback_has_stopped_the_machine(diary: Path) -> None:
    rolling = with_limits(Limits(keep=(RAIL,), fallback=(Term.linear(x=0),)))
    cart = keeping_limits(answering(SlowCart(rolling)))
    assert isinstance(cart, GuardedRollouts)
    pushed(cart, 2)
    assert until(lambda: len(states(diary)) > 4)
    cart.begin(1)
    steps = len(states(diary))
    assert steps < 100
    time.sleep(3 * (SPEC.sampling_period or 0))
    assert len(states(diary)) == steps


@pytest.mark.parametrize("ends", ["close", "Ctrl-C", "SIGTERM twice"])
def test_an_environment_that_ends_slowly_is_not_killed_before_the_safety_fallback_has_stopped_the_machine(
    tmp_path: Path, diary: Path, ends: str
) -> None:
    program = tmp_path / "program.py"
    program.write_text(SLOW)
    path = os.pathsep.join(map(str, ("tests", os.environ.get("PYTHONPATH", ""))))
    with subprocess.Popen(
        [sys.executable, str(program), ends],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    ) as child:
        assert child.stdout is not None
        number = int(child.stdout.readline())
        if ends == "SIGTERM twice":
            for _ in range(2):
                taken = len(states(diary))
                os.kill(number, signal.SIGTERM)
                assert until(partial(more_than, diary, taken + 1))
    assert until(lambda: diary.read_text().endswith("close\n"), 20)
    assert at_rest(diary)


def test_after_a_step_that_took_too_long_the_safety_fallback_stops_the_machine(diary: Path) -> None:
    with IsolatedEnvironment(LateCart, step_limit=0.6) as environment:
        environment.begin(0)
        for _ in range(2):
            environment.act(RIGHT)
        with pytest.raises(StepTimedOut):
            environment.act(RIGHT)
        assert at_rest(diary)
        assert diary.read_text().endswith("close\n")
        assert environment.fallback_steps == len(states(diary)) - 3


@pytest.mark.parametrize("then", ["act", "close"])
def test_a_fallback_after_the_environments_own_process_was_asked_to_end_is_counted(diary: Path, then: str) -> None:
    with IsolatedEnvironment(Cart) as environment:
        environment.begin(0)
        environment.act(RIGHT)
        assert environment._process is not None
        environment._process.terminate()  # as a service manager does, which ends all processes of a service
        environment._process.join(20)
        if then == "act":  # no step in a new process, whose episode has not begun
            with pytest.raises(EnvironmentDied, match="ended with exit code 0 before act"):
                environment.act(RIGHT)
    assert at_rest(diary)
    assert environment.fallback_steps == len(states(diary)) - 1 > 0


def test_an_isolated_environment_keeps_its_declared_limits() -> None:
    with IsolatedEnvironment(PatientCart) as environment:
        environment.begin(0)
        reached = [environment.act(RIGHT).next_coordinates for _ in range(30)]
    assert not past(SPEC, np.array(reached)).any()


def test_a_fallback_by_the_name_of_a_program_acts_as_the_same_fallback_of_terms() -> None:
    reached = {}
    for made, fallback in ((PatientCart, None), (NamedCart, "brake=support.limited:brake")):
        with IsolatedEnvironment(made, fallback=fallback) as environment:
            environment.begin(0)
            reached[made] = [environment.act(RIGHT).next_coordinates for _ in range(30)]
    np.testing.assert_allclose(reached[NamedCart], reached[PatientCart])
    episode = open_episode("cart:Cart", None, NamedCart, "brake=support.limited:brake")
    episode.reset(0)
    assert any(episode.step(RIGHT).fell_back for _ in range(30))


@pytest.mark.parametrize(
    ("made", "fallback", "said"),
    [
        (NamedCart, None, "expected --fallback brake=package.module:function, got none"),
        (NamedCart, "stop=support.limited:brake", "expected --fallback brake=package.module:function, got stop="),
        (NamedCart, "brake=support.limited:DIARY", "to be callable, got a str"),
        (NamedCart, "brake=support.limited:parking", "has no attribute 'parking'"),
        (NamedCart, "brake", "expected --fallback brake=package.module:function, got brake"),
        (NamedCart, "brake=support.limited:two", r"tried at a start, without a step: expected 1 finite"),
        (NamedCart, "brake=support.limited:broken", "tried at a start, without a step: RuntimeError: no pressure"),
        (PatientCart, "brake=support.limited:brake", "expected a specification whose limits name a program"),
        (FreeCart, "brake=support.limited:brake", "expected a specification whose limits name a program"),
    ],
)
def test_a_named_fallback_without_its_program_is_refused_before_the_first_step(
    diary: Path, made: type[Cart], fallback: str | None, said: str
) -> None:
    with pytest.raises(UnknownEnvironment, match=said), IsolatedEnvironment(made, fallback=fallback) as environment:
        environment.begin(0)
    with pytest.raises(UnknownEnvironment, match=said):
        keeping_limits(answering(made()), fallback)
    with pytest.raises(UnknownEnvironment, match=said):
        open_episode("cart:Cart", None, made, fallback)
    assert set(diary.read_text().splitlines()) == {"close"}


def test_the_action_of_a_fallback_program_is_clipped_and_has_to_have_the_actions_size() -> None:
    guard = Guard(NamedCart().spec(), lambda coordinates: 1e3 * coordinates[:1])
    guard.begin(np.array([-2.0, 0.0]))
    assert guard.choose(RIGHT)[0] == -1.0
    for wrong in ([0.0, 0.0], [np.nan]):
        with pytest.raises(StepFailed, match="expected 1 finite numbers from the fallback's program"):
            Guard(NamedCart().spec(), lambda _, wrong=wrong: wrong).fallback()


def test_setting_a_state_within_the_margin_of_a_limit_is_refused() -> None:
    class Settable:
        def spec(self):
            return SPEC.model_copy(update={"query": "step"})

        def step_from(self, coordinates, action):
            return RealStep(coordinates, action, coordinates, 0.0)

        def close(self):
            pass

    environment = keeping_limits(Settable())
    assert isinstance(environment, GuardedSteps)
    assert environment.step_from(np.zeros(2), RIGHT).reward == 0.0
    with pytest.raises(StepRefused, match="limit 'rail'"):
        environment.step_from(np.array([0.95, 0.0]), RIGHT)


def test_an_episode_step_reports_if_the_safety_fallback_replaced_its_action() -> None:
    episode = open_episode("cart:Cart", None, PatientCart)
    episode.reset(0)
    moments = [episode.step(RIGHT) for _ in range(30)]
    episode.close()
    assert not past(SPEC, np.array([moment.coordinates for moment in moments])).any()
    assert any(moment.fell_back for moment in moments)
    assert not moments[0].fell_back
