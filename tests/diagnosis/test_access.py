"""What repeated steps and resets say of an environment, and how it should be used."""

from __future__ import annotations

import re
import sys
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import surrogym.cli.commands
from surrogym_sampler.diagnosis.access import Access, CheckFailed, examine
from surrogym_sampler.diagnosis.doctor import environment
from surrogym_sampler.original import RealStep
from surrogym_sampler.original.adapters.gymnasium_ids import ResetOnly
from surrogym_sampler.original.errors import StepFailed
from surrogym_sampler.original.isolated import IsolatedEnvironment
from surrogym_sampler.original.simulator import Simulated
from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform

COMMANDS = Path(surrogym.cli.commands.__file__).parent
PAGES = Path(__file__).parents[2] / "docs" / "how-to"
RANGE = Uniform(low=-1, high=1)


class Rail:
    """A cart on a rail: ``coarse`` puts it elsewhere than asked, ``noise`` shakes it, ``inertia`` is remembered."""

    def __init__(self, coarse=0.0, noise=0.0, inertia=0.0, resets=True, query="step"):
        self._coarse, self._noise, self._inertia, self._query = coarse, noise, inertia, query
        self._rng, self._moved, self._x = np.random.default_rng(), 0.0, 0.0
        if not resets:
            self.begin = self.act = None

    def spec(self):
        return EnvironmentSpec(
            coordinates=(Coordinate(name="x", sampling=RANGE),),
            observation=(ObservationEntry(name="x", term=Term.linear(x=1)),),
            action=BoxAction(low=(-1,), high=(1,)),
            start={"x": RANGE},
            time_limit=20,
            query=self._query,
        )

    def step_from(self, coordinates, action):
        self._x, self._moved = float(coordinates[0]) + self._coarse, 0.0
        return self.act_from(action)

    def begin(self, seed=None):
        self._x, self._moved = float(np.random.default_rng(seed).uniform(-0.5, 0.5)), 0.0
        return np.array([self._x])

    def act(self, action):
        return self.act_from(action)

    def act_from(self, action):
        before = self._x
        self._moved = 0.3 * float(action[0]) + self._inertia * self._moved + self._noise * self._rng.standard_normal()
        self._x = float(np.clip(before + 0.1 * self._moved, -1, 1))
        return RealStep([before], action, [self._x], -(before**2))

    def close(self):
        pass


class SavedRail(Rail):
    """A rail that remembers its last motion and keeps all of it in a snapshot, or forgets the motion."""

    def __init__(self, forgets=False, **options):
        super().__init__(**options)
        self._forgets = forgets

    def save(self):
        return np.array([self._x, 0.0 if self._forgets else self._moved]).tobytes()

    def restore(self, snapshot):
        self._x, self._moved = np.frombuffer(snapshot).tolist()
        return np.array([self._x])


def looked_at(rail=Rail, **options) -> Access:
    factory = partial(rail, **options)
    with IsolatedEnvironment(factory) as environment:
        return examine(environment, factory().spec())


def test_an_environment_that_can_be_set_exactly_is_diagnosed_as_settable() -> None:
    access = looked_at()
    assert (access.set_error, access.repeat_error, access.reset_error, access.memory_error) == (0, 0, 0, 0)
    assert access.mode == "set any state"
    assert (access.steps, access.resets) == (2 * 3 + 2 * 3 + 1, 2)


def test_an_environment_set_inexactly_is_diagnosed_as_reset_only() -> None:
    access = looked_at(coarse=0.1)
    assert access.set_error == pytest.approx(0.05)
    assert access.mode == "reset only (--access reset)"


def test_an_environment_with_hidden_state_is_diagnosed_as_reset_only() -> None:
    access = looked_at(inertia=3.0)
    assert access.set_error == access.repeat_error == 0
    assert access.memory_error is not None
    assert access.memory_error > 0.01
    assert not access.can_set


def test_a_noisy_environment_is_diagnosed_as_settable() -> None:
    access = looked_at(noise=0.05)
    assert access.noise > 0
    assert access.can_set


def test_an_environment_without_resets_is_diagnosed_by_setting_states() -> None:
    access = looked_at(resets=False)
    assert (access.reset_error, access.resets, access.can_set) == (None, 0, True)


def test_the_diagnosis_does_not_set_states_of_a_reset_only_environment() -> None:
    access = looked_at(query="rollout")
    assert (access.set_error, access.memory_error) == (None, None)
    assert (access.reset_error, access.mode) == (0, "reset only (--access reset)")


def test_an_environment_with_hidden_state_and_exact_snapshots_is_diagnosed_as_restorable() -> None:
    access = looked_at(SavedRail, inertia=3.0)
    assert (access.can_set, access.restore_error) == (False, 0)
    assert access.mode == "snapshots (--access snapshot)"


def test_the_diagnosis_takes_the_number_of_real_steps_that_the_docs_state() -> None:
    """They said 14, and the check took 18."""
    with IsolatedEnvironment(SavedRail) as opened:
        said = [finding.said for finding in environment(lambda: opened)]
    assert said[-1] == "set any state; this took 18 real steps and 4 resets at most"
    told = (COMMANDS / "doctor.py", *(PAGES / f"{name}.md" for name in ("environments-by-name", "own-environment")))
    for path in told:
        assert re.search(r"\b18 (real steps )?(at most|if)", text := path.read_text(encoding="utf-8")), path
        assert "14 real steps at most" not in text


def test_an_environment_with_incomplete_snapshots_is_diagnosed_as_reset_only() -> None:
    access = looked_at(SavedRail, inertia=3.0, forgets=True)
    assert access.restore_error is not None
    assert access.restore_error > 0.01
    assert access.mode == "reset only (--access reset)"


class Deaf(Rail):
    """A rail whose start no seed decides."""

    def begin(self, seed=None):
        return super().begin(None)


class Spring(gymnasium.Env):
    """A mass on a spring. Its state has no public name, so it can only be reset."""

    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    observation_space = gymnasium.spaces.Box(-10, 10, (2,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._s = self.np_random.uniform(-1, 1, 2)
        return self._s.copy(), {}

    def step(self, action):
        x, v = self._s
        self._s = np.array([x + 0.1 * v, v + 0.1 * (float(action[0]) - x - 0.2 * v)])
        return self._s.copy(), -float(x**2), False, False, {}


@pytest.mark.parametrize("query", ["step", "rollout"])
def test_the_diagnosis_notes_an_environment_that_ignores_its_seed(query: str) -> None:
    opened = partial(IsolatedEnvironment, partial(Deaf, query=query))
    said = {finding.name: finding for finding in environment(opened)}
    assert "ignores its seed" in said["resets"].said
    assert said["resets"].notable
    assert all(finding.way_out is None for finding in said.values())
    steady = {finding.name: finding for finding in environment(partial(IsolatedEnvironment, Rail))}
    assert not steady["resets"].notable


def test_a_gymnasium_environment_that_can_only_be_reset_is_diagnosed_as_reset_only() -> None:
    """Its simulator gave a state to save, and failed when it had to return to it."""
    simulator = ResetOnly("Spring", Spring(), 60)
    spec = Rail(query="rollout").spec().model_dump() | {
        "coordinates": [{"name": name, "sampling": RANGE} for name in ("o0", "o1")],
        "observation": [{"name": name, "term": Term.linear(**{name: 1})} for name in ("o0", "o1")],
        "start": {"o0": RANGE, "o1": RANGE},
    }
    opened = Simulated(simulator, EnvironmentSpec.model_validate(spec))
    said = {finding.name: finding for finding in environment(lambda: opened)}
    assert said["mode"].way_out is None
    assert said["mode"].said.startswith("reset only (--access reset)")
    with pytest.raises(StepFailed):
        opened.save()


class Exits(Rail):
    """Ends its process at its third step."""

    steps = 0

    def step_from(self, coordinates, action):
        self.steps += 1
        if self.steps == 3:
            sys.exit("the licence has expired")
        return super().step_from(coordinates, action)


def test_the_diagnosis_of_a_failing_environment_reports_its_real_steps() -> None:
    with pytest.raises(CheckFailed, match="SystemExit: the licence has expired") as failed:
        looked_at(Exits)
    assert failed.value.steps == 3
