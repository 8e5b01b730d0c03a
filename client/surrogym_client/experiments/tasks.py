"""The tasks of the demo: environment, budget of real steps, and criterion of success.

Everything else is derived from the specification. Imports nothing, so that a command line can list them.
"""

from __future__ import annotations

from dataclasses import dataclass

MIN_DESIGN = 20
ROUNDS = 3  # of the closed loop, while the design is not ready


@dataclass(frozen=True)
class Starts:
    """Other starts than the environment's own, for a second evaluation: ``wide`` is anywhere in the sampling range,
    ``scale`` spreads the declared starts so many times as far."""

    words: str
    wide: bool = False
    scale: float = 1.0


@dataclass(frozen=True)
class Outcome:
    """Results of 100 episodes."""

    mean: float
    lowest: float
    success: float | None  # share of the episodes


@dataclass(frozen=True)
class Target:
    """Criteria for one run. Every given value must be reached."""

    words: str
    mean: float | None = None
    lowest: float | None = None
    success: float | None = None
    also_success: float | None = None  # of the second evaluation

    def reached(self, real: Outcome, also: Outcome | None = None) -> bool:
        pairs = [(real.mean, self.mean), (real.lowest, self.lowest), (real.success, self.success)]
        pairs.append((None if also is None else also.success, self.also_success))
        return all(wanted is None or (got is not None and got >= wanted) for got, wanted in pairs)


@dataclass(frozen=True)
class DemoTask:
    """A task of a demo, and its budget of real steps."""

    environment: str
    budget: int
    target: Target
    also: Starts | None = None
    steps: int | None = None  # virtual ones, all rounds together; None derives them from the specification


TASKS = {
    "pendulum": DemoTask(
        "Pendulum-v1",
        budget=14,
        target=Target("mean -160, all upright; whole box 98 %", mean=-160, success=1.0, also_success=0.98),
        also=Starts("the whole box", wide=True),
    ),
    "cartpole": DemoTask(
        "CartPole-v1",
        budget=8,
        target=Target("all 500, starts within 0.1 too", lowest=500, success=1.0, also_success=1.0),
        also=Starts("starts within 0.1", scale=2.0),
    ),
    "mountaincar": DemoTask("MountainCarContinuous-v0", budget=8, target=Target("mean 93", mean=93)),
    "swingup": DemoTask("surrogym/CartPoleSwingUp-v0", budget=60, target=Target("95 % upright", success=0.95)),
    "swingup-narrow": DemoTask(
        "surrogym/CartPoleSwingUpNarrow-v0", budget=100, target=Target("95 % upright", success=0.95)
    ),
    "acrobot": DemoTask(
        "Acrobot-v1", budget=100, target=Target("mean -90, none at -500", mean=-90, lowest=-499), steps=1_750_000
    ),
    "invertedpendulum": DemoTask("InvertedPendulum-v5", budget=20, target=Target("all 1,000", lowest=1_000)),
    "doublependulum": DemoTask("InvertedDoublePendulum-v5", budget=200, target=Target("mean 9,000", mean=9_000)),
    "reacher": DemoTask("Reacher-v5", budget=100, target=Target("mean -6", mean=-6)),
}

# Ten tasks of the study of trust. Nobody tunes the method on them. Targets: four fifths of the way from no action to a
# policy that CMA-ES learned on the task itself (tests/benchmarks/unseen_targets.py).
UNSEEN = {
    name: DemoTask(f"surrogym_client.experiments.unseen.tasks:{kind}", budget, Target(f"mean {mean:g}", mean=mean))
    for name, kind, budget, mean in (
        ("narrow-plane", "NarrowPlane", 100, 67),
        ("narrow-arm", "NarrowArm", 150, 70),
        ("kinetics", "Kinetics", 100, -97),
        ("stick-slip", "StickSlip", 60, -5.3),
        ("process-noise", "NoisyPendulum", 100, -380),
        ("sensor-noise", "NoisySensors", 100, -30),
        ("contact", "Contact", 100, -34),
        ("fast-and-slow", "FastAndSlow", 60, -30),
        ("spring-chain", "SpringChain", 150, -51),
        ("reset-only", "ResetOnly", 150, -19),
    )
}

# Environments of other packages, described by random steps before the design. The targets of dm_control's tasks are
# above what TD-MPC2 reaches with 100,000 steps (724, 839 and 937). The tank's is 5 % below its own oracle (-0.0118).
BY_NAME = {
    "dm-pendulum": DemoTask("dm_control:pendulum-swingup", 60, Target("mean 750", mean=750)),
    "dm-cartpole": DemoTask("dm_control:cartpole-swingup", 100, Target("mean 860", mean=860)),
    "dm-reacher": DemoTask("dm_control:reacher-easy", 300, Target("mean 950", mean=950)),
    "stirred-tank": DemoTask("pcgym:cstr", 100, Target("mean -0.0124", mean=-0.0124)),
    "swimmer": DemoTask("Swimmer-v5", 1_000, Target("mean 100", mean=100)),
}
EVERY_TASK = TASKS | UNSEEN | BY_NAME


def design_budget(budget: int) -> int:
    """Real steps of the design before the first policy: two fifths, with a minimum."""
    return min(budget, max(MIN_DESIGN, 2 * budget // 5))


def queries_a_round(budget: int) -> int:
    """Return the real steps of each round of the closed loop for a whole ``budget``; 0 if the design takes it all."""
    return (budget - design_budget(budget)) // ROUNDS
