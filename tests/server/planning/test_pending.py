"""Actions that take effect later: their dead time is found, and a plan begins where they do."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from support.models import learn
from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples
from surrogym_server.local import LocalSurrogate
from surrogym_server.models.abilities import ArrayTransition
from surrogym_server.planning.grid import _transitions
from surrogym_server.planning.pending import PendingActions
from surrogym_shared.spec import Coordinate, ObservationEntry, Term, Uniform, with_history

MOTION = np.array([[1.0, 0.1], [0.0, 0.9]])
PUSH = np.array([0.01, 0.2])


class Late:
    """Steps of a cart that a force pushes after a dead time: ``shares`` of the actions of age 0, 1, 2, ... act."""

    def __init__(self, *shares: float) -> None:
        self.shares = shares
        spec = pendulum().model_copy(update={"query": "rollout"})
        own = tuple(Coordinate(name=c.name, sampling=Uniform(low=-5, high=5)) for c in spec.coordinates)
        shown = tuple(ObservationEntry(name=c.name, term=Term.linear(**{c.name: 1})) for c in own)
        plain = spec.model_copy(update={"coordinates": own, "observation": shown})
        lagged = with_history(plain, actions=len(shares) - 1)
        self.spec, self.definition = lagged, definition_from_spec(lagged)

    def __call__(self, q, u, **options):
        acting = np.concatenate([u, q[:, 2:]], 1) @ self.shares
        moved = q[:, :2] @ MOTION.T + acting[:, None] * PUSH
        after = np.concatenate([moved, u, q[:, 2:-1]], 1)
        return ArrayTransition(after, moved[:, 0], np.zeros((len(q), 3)), np.zeros(len(q), dtype=bool))


@pytest.mark.parametrize(
    ("shares", "dead", "late"),
    [
        ((1.0, 0.0), 0, False),
        ((0.6, 0.4), 0, True),
        ((0.0, 1.0), 1, False),
        ((0.0, 0.0, 0.5, 0.5), 2, True),
        ((0.001, 0.0, 1.0), 2, False),
    ],
)
def test_the_dead_time_is_found(shares: tuple[float, ...], dead: int, late: bool):
    found = PendingActions.of(Late(*shares))  # type: ignore[arg-type]
    assert (found.dead, found.late) == (dead, late)
    assert found.early.tolist() == [[2 + age, 0] for age in range(dead)]


def test_rounding_errors_are_no_effect():
    class Rounding(Late):
        def __call__(self, q, u, **options):
            found = super().__call__(q, u, **options)
            found.q_next[:, 0] = q[:, 0] + 1e-12 * u[:, 0]
            return found

    assert PendingActions.of(Rounding(0.0, 1.0)).dead == 1  # type: ignore[arg-type]


def test_the_state_is_predicted_for_when_an_action_takes_effect():
    steps = Late(0.0, 0.0, 0.5, 0.5)
    pending, q = PendingActions.of(steps), np.array([[1.0, 0.5, 0.7, -0.3, 0.4]])  # type: ignore[arg-type]
    begun = q
    for action in (1.5, -1.5):  # whatever is chosen now does not act before
        begun = steps(begun, np.array([[action]])).q_next
    np.testing.assert_allclose(pending.forecast(q, np.zeros_like(q))[:, :2], begun[:, :2])


def test_what_a_policy_on_a_grid_sees_follows_from_what_it_saw_before_and_its_action():
    steps = Late(0.0, 0.7, 0.3)
    pending = PendingActions.of(steps)  # type: ignore[arg-type]
    q, actions = np.array([[1.0, 0.5, 0.7, -0.3]]), np.array([[-1.5], [0.5]])
    seen = pending.seen(q)[:, :2]
    q_next, _, _ = _transitions(pending, seen, actions, 0.0, None)
    for action, expected in zip(actions, q_next[0], strict=True):
        after = steps(q, action[None]).q_next
        np.testing.assert_allclose(pending.seen(after)[0, :2], expected, rtol=1e-5)


def test_a_planner_brings_a_cart_to_rest_through_a_dead_time():
    steps, rng = Late(0.0, 0.7, 0.3), np.random.default_rng(0)
    spec = steps.spec.model_copy(update={"time_limit": 40})
    q, u = rng.uniform((-5, -5, -2, -2), (5, 5, 2, 2), (60, 4)), rng.uniform(-2, 2, (60, 1))
    after = steps(q, u).q_next
    samples = Samples(*map(torch.tensor, (q, u, after, -np.square(after[:, 0]), np.zeros(60, dtype=bool))))
    cart = LocalSurrogate(spec, learn(definition_from_spec(spec), samples).model)
    planner = cart.planner(8)
    assert (planner.pending.dead, planner.pending.late) == (1, True)
    at = np.array([[1.0, 0.0, 0.0, 0.0]])
    for _ in range(60):
        at = steps(at, planner.from_states(at)).q_next
    assert np.abs(at[0, :2]).max() < 0.1
