"""A driven hinge whose physical parameters are attributes: the textbook's, and a real one with other values."""

from __future__ import annotations

import math

import numpy as np

from surrogym_client.transport import Api
from surrogym_sampler.original.protocol import Array, RealStep
from surrogym_shared import wire
from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform

PERIOD = 0.1
RANGES = {"angle": Uniform(low=-math.pi, high=math.pi), "speed": Uniform(low=-4, high=4)}


def hinge_spec(**fields: object) -> EnvironmentSpec:
    made = EnvironmentSpec(
        environment="support.hinge:Real",
        coordinates=(
            Coordinate(name="angle", kind="angle", sampling=RANGES["angle"], unit="rad"),
            Coordinate(name="speed", sampling=RANGES["speed"], unit="rad/s"),
        ),
        observation=(
            ObservationEntry(name="cos", term=Term.cos(angle=1)),
            ObservationEntry(name="sin", term=Term.sin(angle=1)),
            ObservationEntry(name="speed", term=Term.linear(speed=1)),
        ),
        action=BoxAction(low=(-1,), high=(1,)),
        start=RANGES,
        time_limit=50,
    )
    return EnvironmentSpec.model_validate({**made.model_dump(), **fields})


class Textbook:
    """The hinge of the textbook."""

    parallel = True
    mass = 1.0
    length = 1.0
    friction = 0.2

    def spec(self) -> EnvironmentSpec:
        return hinge_spec()

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        angle, speed = map(float, coordinates)
        push, inertia = float(np.ravel(action)[0]), self.mass * self.length**2
        drag = self.friction * speed * abs(speed)
        force = (push * math.cos(angle) - drag) / inertia - 9.81 / self.length * math.sin(angle)
        after = speed + PERIOD * (force + self.more(speed))
        turned = (angle + PERIOD * after + math.pi) % (2 * math.pi) - math.pi
        return RealStep((angle, speed), (push,), (turned, after), -(1 - math.cos(angle)) - 0.1 * speed**2)

    def more(self, speed: float) -> float:
        """What the textbook does not know of the acceleration."""
        del speed
        return 0.0

    def close(self) -> None:
        pass


class Real(Textbook):
    """The real one: other parameters."""

    mass = 1.3
    length = 0.8
    friction = 0.4


class Stiff(Real):
    """A real one with Coulomb friction, of which the textbook knows nothing."""

    def more(self, speed: float) -> float:
        return -1.5 * math.tanh(4 * speed)


class Backwards(Textbook):
    """A simulator that turns the wrong way, and pushes the wrong way."""

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        step = super().step_from(np.negative(coordinates), action)
        return RealStep(tuple(coordinates), step.action, step.next_coordinates, step.reward)


class Broken(Textbook):
    """A simulator that diverges everywhere."""

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        raise FloatingPointError("the solver diverged")


def steps_of(plant: Textbook, count: int, seed: int = 0) -> list[RealStep]:
    """Real steps from states and actions drawn evenly."""
    rng = np.random.default_rng(seed)
    lows, highs = (np.array([getattr(one, end) for one in RANGES.values()]) for end in ("low", "high"))
    starts = rng.uniform(lows, highs, (count, 2))
    return [plant.step_from(q, u) for q, u in zip(starts, rng.uniform(-1, 1, (count, 1)), strict=True)]


def sent(api: Api, name: str, count: int) -> None:
    """Send real steps by hand to the surrogate of this name."""
    samples = [
        wire.NewSample(
            coordinates=list(s.coordinates),
            action=list(s.action),
            next_coordinates=list(s.next_coordinates),
            reward=s.reward,
            terminated=False,
        )
        for s in steps_of(Real(), count)
    ]
    api.add_samples(name, "test", samples)


class Renamed(Textbook):
    """A simulator whose coordinates have other names."""

    def spec(self) -> EnvironmentSpec:
        fields = hinge_spec().model_dump()
        text = EnvironmentSpec.model_validate(fields).model_dump_json().replace("speed", "rate")
        return EnvironmentSpec.model_validate_json(text)


class Weaker(Textbook):
    """A simulator with other action limits."""

    def spec(self) -> EnvironmentSpec:
        return hinge_spec(action=BoxAction(low=(-0.5,), high=(0.5,)).model_dump())


class Degrees(Textbook):
    """A simulator that computes in degrees, and says rad."""

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        step = super().step_from(np.radians(coordinates), action)
        return RealStep(tuple(coordinates), step.action, tuple(np.degrees(step.next_coordinates)), step.reward)


class Faster(Textbook):
    """A simulator whose step is half as long as that of a plant with a step every 0.1 s."""

    def spec(self) -> EnvironmentSpec:
        return hinge_spec(sampling_period=PERIOD / 2)


class Elsewhere(Textbook):
    """A simulator that works in a small part of its range alone."""

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        if abs(coordinates[0]) > 1:
            raise FloatingPointError("the solver diverged")
        return super().step_from(coordinates, action)


class Partial(Textbook):
    """A simulator that prints, and that fails in a part of its range."""

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        print("hello from the simulator")
        if coordinates[1] < -3:
            raise FloatingPointError("the solver diverged")
        return super().step_from(coordinates, action)


class Noisy(Textbook):
    """A simulator with noise that differs from step to step."""

    taken = 0

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        step, self.taken = super().step_from(coordinates, action), self.taken + 1
        angle, speed = step.next_coordinates
        return RealStep(step.coordinates, step.action, (angle, speed + 0.1 * math.sin(self.taken)), step.reward)
