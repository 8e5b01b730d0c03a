"""The tasks of the demo: environment, budget of real steps, and criterion of success.

Everything else is derived from the specification. Imports nothing, so that a command line can list them.
"""

from __future__ import annotations

from dataclasses import dataclass

MIN_DESIGN = 20
ROUNDS = 3  # most rounds of the closed loop (train a policy, then query at states that it visits)


@dataclass(frozen=True)
class Starts:
    """Starts of a second evaluation: ``wide`` starts anywhere in the sampling range, ``scale`` widens the declared
    start distribution by this factor."""

    words: str
    wide: bool = False
    scale: float = 1.0


@dataclass(frozen=True)
class Outcome:
    """Results of the 100 episodes of an evaluation: mean and lowest return, and share of successes."""

    mean: float
    lowest: float
    success: float | None  # share of the episodes that were a success; None without a criterion


@dataclass(frozen=True)
class Target:
    """Results that one run of a demo has to reach; None is no requirement."""

    words: str
    mean: float | None = None
    lowest: float | None = None
    success: float | None = None
    also_success: float | None = None  # share of successes in the second evaluation, from other starts

    def reached(self, real: Outcome, also: Outcome | None = None) -> bool:
        pairs = [(real.mean, self.mean), (real.lowest, self.lowest), (real.success, self.success)]
        pairs.append((None if also is None else also.success, self.also_success))
        return all(wanted is None or (got is not None and got >= wanted) for got, wanted in pairs)


@dataclass(frozen=True)
class DemoTask:
    """A task of the demo: its environment, its budget of real steps, and the results to reach."""

    environment: str
    budget: int
    target: Target
    also: Starts | None = None


TASKS = {
    "pendulum": DemoTask(
        "Pendulum-v1",
        budget=14,
        target=Target("mean -160, all upright; anywhere 98 %", mean=-160, success=1.0, also_success=0.98),
        also=Starts("starts anywhere in the range", wide=True),
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
    "acrobot": DemoTask("Acrobot-v1", budget=100, target=Target("mean -90, none at -500", mean=-90, lowest=-499)),
    "invertedpendulum": DemoTask("InvertedPendulum-v5", budget=20, target=Target("all 1,000", lowest=1_000)),
    "doublependulum": DemoTask("InvertedDoublePendulum-v5", budget=200, target=Target("mean 9,000", mean=9_000)),
    "reacher": DemoTask("Reacher-v5", budget=100, target=Target("mean -6", mean=-6)),
}


def design_budget(budget: int) -> int:
    """Return the real steps that the design takes before the first policy: two fifths of the budget, with a minimum."""
    return min(budget, max(MIN_DESIGN, 2 * budget // 5))


def queries_a_round(budget: int) -> int:
    """Return how many real steps each round of the closed loop takes, if design and rounds together have ``budget``
    steps; 0 if the design takes all of them."""
    return (budget - design_budget(budget)) // ROUNDS
