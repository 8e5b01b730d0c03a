"""A dead time or a state that is not measured is no noise: the step before explains the error."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples
from surrogym_server.models.guard import learn
from surrogym_server.sampling.design import advance
from surrogym_server.sampling.judging import Judgement, judge_model
from surrogym_server.sampling.noise import repeats
from surrogym_server.sampling.past import EXPLAINED, pairs_lacking
from surrogym_server.sampling.rules import LENGTH as LONGER
from surrogym_server.sampling.state import DesignState, Request
from surrogym_server.sampling.tolerances import default_tolerances
from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform

COUNT, LENGTH = 60, 12
SPEC = EnvironmentSpec(
    environment="a mass on a spring",
    coordinates=(Coordinate(name="x", sampling=Uniform(low=-2, high=2)),),
    observation=(ObservationEntry(name="x", term=Term.linear(x=1)),),
    action=BoxAction(low=(-1.0,), high=(1.0,)),
    start={"x": Uniform(low=-1, high=1)},
    time_limit=20,
    query="rollout",
)
DEFINITION = definition_from_spec(SPEC)
Next = Callable[[np.ndarray, float, float, np.random.Generator], tuple[np.ndarray, float]]


def lag(s: np.ndarray, u: float, before: float, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Without a past: (next state, what is measured of it)."""
    after = np.array([0.9 * s[0] + u / 2, 0.0])
    return after, after[0]


def dead_time(s: np.ndarray, u: float, before: float, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    return lag(s, before, u, rng)


def hidden_speed(s: np.ndarray, u: float, before: float, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    after = np.array([s[0] + 0.2 * s[1], s[1] + 0.5 * (u - s[0] - 0.2 * s[1])])
    return after, after[0]


def of_process(s: np.ndarray, u: float, before: float, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    after, _ = lag(s, u, before, rng)
    after[0] += 0.1 * rng.normal()
    return after, after[0]


def of_sensor(s: np.ndarray, u: float, before: float, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    after, seen = lag(s, u, before, rng)
    return after, seen + 0.1 * rng.normal()


def judged(follow: Next, seed: int = 0) -> Judgement:
    """Verdict on a model of episodes with random actions."""
    rng = np.random.default_rng(seed)
    rows: list[tuple[float, float, float]] = []
    for _ in range(COUNT // LENGTH):
        state, before = rng.uniform(-1, 1, 2), 0.0
        seen = state[0]
        for u in rng.uniform(-1, 1, LENGTH):
            state, seen_after = follow(state, u, before, rng)
            rows.append((seen, u, seen_after))
            seen, before = seen_after, u
    q, u, q_next = (torch.tensor(column, dtype=torch.float64)[:, None] for column in np.array(rows).T)
    taken = Samples(q, u, q_next, -(q[:, 0] ** 2), torch.zeros(len(rows), dtype=torch.bool))
    model = learn(DEFINITION, taken, {}).model
    defaults = default_tolerances(DEFINITION, model.scales.tolist())
    return judge_model(model, taken, defaults, Request(COUNT, 0.9), DesignState())


def longer_dead_time(s: np.ndarray, u: float, before: float, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Two steps: the second number of the state is the action of the step before."""
    return np.array([0.9 * s[0] + s[1] / 2, before]), 0.9 * s[0] + s[1] / 2


@pytest.mark.parametrize("follow", [dead_time, longer_dead_time, hidden_speed])
def test_residuals_explained_by_the_previous_step_are_not_taken_for_noise(follow: Next) -> None:
    position, reward = judged(follow).confidences
    assert position.past >= EXPLAINED
    assert position.noise == position.sensor_noise == reward.noise == 0


@pytest.mark.parametrize("follow", [lag, of_process, of_sensor])
def test_independent_noise_is_not_attributed_to_the_previous_step(follow: Next) -> None:
    position, _ = judged(follow).confidences
    assert position.past == 0
    assert (position.noise > 0) is (follow is of_sensor)


def single_steps() -> Samples:
    """Steps of a hidden speed, each from a reset: they show nothing of a past."""
    rng = np.random.default_rng(0)
    rows = []
    for _ in range(20):
        state, u = rng.uniform(-1, 1, 2), rng.uniform(-1, 1)
        rows.append((state[0], u, hidden_speed(state, u, 0.0, rng)[1]))
    q, u, q_next = (torch.tensor(column, dtype=torch.float64)[:, None] for column in np.array(rows).T)
    return Samples(q, u, q_next, torch.zeros(20, dtype=torch.float64), torch.zeros(20, dtype=torch.bool))


@pytest.mark.parametrize(("budget", "longer"), [(60, False), (40, True)])
def test_after_half_its_budget_a_design_of_single_steps_queries_longer_rollouts(budget: int, longer: bool) -> None:
    taken = single_steps()
    lacking = pairs_lacking(DEFINITION, taken)
    assert lacking > 0
    request = Request(budget, 0.999)
    planned = advance(DEFINITION, taken, DesignState(), request).queries
    gained = sum(query.steps - 1 for query in planned)
    assert (gained >= min(lacking, (budget - len(taken)) // LONGER * (LONGER - 1))) is longer


def test_equal_steps_with_different_previous_steps_are_not_repeats() -> None:
    rows = torch.tensor([[0.0, 1.0, 0.5], [0.5, 1.0, 0.7], [0.2, -1.0, 0.5], [0.5, 1.0, 0.3]], dtype=torch.float64)
    nothing = torch.zeros(4, dtype=torch.float64)
    taken = Samples(rows[:, :1], rows[:, 1:2], rows[:, 2:], nothing, nothing.bool())
    model = SimpleNamespace(definition=DEFINITION)
    assert repeats(model, taken).degrees == 0
    assert repeats(model, taken.at(torch.tensor([0, 1, 0, 1]))).degrees == 2
