"""Gymnasium's pendulum, of which the angle alone is measured: its speed follows from the last change of the angle.

surrogym register hidden_speed:AngleAlone --name angle --budget 60
surrogym sample angle --env hidden_speed:AngleAlone --until-done
surrogym train angle --out angle.zip
surrogym evaluate angle.zip --env hidden_speed:AngleAlone

A reset leaves the pendulum at any angle, and at a speed that nobody knows, so the first step of each episode is not
learned from. `python past.py hidden_speed` does all this for five seeds.
"""

import math

import gymnasium

from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    EnvironmentSpec,
    Inequality,
    ObservationEntry,
    Success,
    Term,
    Uniform,
    with_history,
)

CIRCLE = Uniform(low=-math.pi, high=math.pi)
STEP, FASTEST, FASTEST_AT_START = 0.05, 8.0, 1.0  # s, rad/s


class AngleAlone:
    """Swing up, and stay. A step lasts 0.05 s."""

    parallel = True

    def __init__(self, changes=1, actions=0):
        self.changes, self.actions = changes, actions
        self.env = gymnasium.make("Pendulum-v1").unwrapped

    def spec(self):
        upright = Inequality(term=Term.cos(angle=1), relation=">", value=0.95)
        plain = EnvironmentSpec(
            environment="pendulum without its speed",
            coordinates=(Coordinate(name="angle", kind="angle", sampling=CIRCLE, unit="rad"),),
            observation=(
                ObservationEntry(name="cos", term=Term.cos(angle=1), low=-1, high=1),
                ObservationEntry(name="sin", term=Term.sin(angle=1), low=-1, high=1),
            ),
            action=BoxAction(low=(-2,), high=(2,)),
            start={"angle": CIRCLE},
            time_limit=200,
            query="rollout",
            success=Success(hold=(upright,), hold_steps=20),
        )
        turn, first_turn = {"angle": STEP * FASTEST}, {"angle": STEP * FASTEST_AT_START}
        return with_history(plain, changes=self.changes, actions=self.actions, largest=turn, at_start=first_turn)

    def reset(self, *, seed=None):
        return self.env.reset(seed=seed)

    def step(self, action):
        return self.env.step(action)

    def coordinates(self, observation):
        return [math.atan2(observation[1], observation[0])]

    def close(self):
        self.env.close()
