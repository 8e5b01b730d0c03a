"""The experiments of the paper's section 5: its two tasks, the compared designs, and the variations for its
policies."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from surrogym_client.runtime.versions import versions
from surrogym_sampler.original import make
from surrogym_sampler.original.loading import with_choices
from surrogym_shared.spec import EnvironmentSpec, Fixed, Normal, Uniform

Preset = Literal["default", "paper"]
Start = dict[str, Uniform | Normal | Fixed]

BIAS = 0.1  # deviation of a physical quantity, as a share of it; the paper names none
ANYWHERE: Literal["anywhere"] = "anywhere"


@dataclass(frozen=True)
class Variation:
    """Real episodes of one kind: where they start, and which physical quantities are off by normal factors.

    ``start`` None is the environment's own; ``upward`` makes quantities larger only; ``traced`` keeps every step. Where
    ``limit``, one of ``physics``, grows, actions grow with it: a full command stays the system's full effort.
    """

    name: str
    episodes: int
    start: Start | Literal["anywhere"] | None = None
    physics: tuple[str, ...] = ()
    sigma: float = BIAS
    upward: bool = False
    limit: str | None = None
    traced: bool = False


@dataclass(frozen=True)
class PaperTask:
    """One of the two tasks, with the paper's numbers of real steps."""

    environment: str
    initial: int
    budget: int
    default_budget: int
    variations: tuple[Variation, ...]

    @property
    def evaluated(self) -> EnvironmentSpec:
        """The task as the paper evaluates it: CartPole for 200 steps."""
        return make(self.environment, preset="paper").spec()


HANGING: Start = {"theta": Fixed(value=-math.pi), "speed": Fixed(value=0)}


def _around(half: float) -> Start:
    return {name: Uniform(low=-half, high=half) for name in ("x", "velocity", "pole", "omega")}


TASKS = {
    "pendulum": PaperTask(
        "Pendulum-v1",
        initial=40,
        budget=125,
        default_budget=14,
        variations=(
            Variation("usual starts", 100),
            Variation("any start", 100, ANYWHERE),
            Variation("five starts", 5, ANYWHERE, traced=True),
            Variation("hanging", 1, HANGING, traced=True),
            Variation(
                "higher limits", 5, HANGING, ("max_torque", "max_speed"), upward=True, limit="max_torque", traced=True
            ),
            Variation("other bodies", 100, None, ("g", "m", "l")),
        ),
    ),
    "cartpole": PaperTask(
        "CartPole-v1",
        initial=50,
        budget=120,
        default_budget=8,
        variations=(
            Variation("starts +-0.05", 300, _around(0.05)),
            Variation("starts +-0.1", 300, _around(0.1)),
            Variation("masses", 100, _around(0.05), ("masscart", "masspole")),
            Variation("masses, half", 100, _around(0.05), ("masscart", "masspole"), sigma=0.5),
        ),
    ),
}


@dataclass(frozen=True)
class Arm:
    """One way to choose the real steps; ``trained`` says whether a policy is learned from them."""

    preset: Preset = "paper"
    design: tuple[tuple[str, str], ...] = ()
    trained: bool = True
    tasks: tuple[str, ...] = ("pendulum", "cartpole")


ARMS = {
    "paper": Arm(design=(("tolerance", "relative"),)),
    "hypercube": Arm(design=(("tolerance", "relative"), ("acquisition", "latin_hypercube")), tasks=("pendulum",)),
    "printed": Arm(trained=False),
    "default": Arm(preset="default"),
}


@dataclass(frozen=True)
class Scale:
    """Size of the experiments: complete, or minimal to check that everything works."""

    steps: int | None = None  # virtual steps of a training; None takes the specification's
    shrink: int = 1  # real steps and episodes are divided by this
    unseen: int = 400  # real steps with which models are compared
    versions: int = 16  # number of a design's models that are compared with them


WHOLE, QUICK = Scale(), Scale(steps=2_048, shrink=10, unseen=20, versions=3)


@dataclass(frozen=True)
class Cell:
    """One design, the policy learned from it, and the policy's results in the original environment."""

    task: str
    arm: str
    seed: int
    scale: Scale = WHOLE

    @property
    def name(self) -> str:
        """Task, arm, seed, and a hash of everything else that the design depends on."""
        scale = [self.scale.unseen, self.scale.versions]
        return f"{self.task}-{self.arm}-seed{self.seed}-{_hash(self.spec.model_dump(mode='json'), scale)}"

    @property
    def policy_name(self) -> str:
        """Name of the cell's policy: a hash of the steps that it is trained for."""
        return f"policy-{_hash(self.scale.steps)}"

    @property
    def episodes_name(self) -> str:
        """Name of the cell's episodes: a hash of the variations in which they run."""
        return f"episodes-{_hash([_plain(v) for v in self.variations])}"

    @property
    def paper_task(self) -> PaperTask:
        return TASKS[self.task]

    @property
    def trained(self) -> bool:
        return ARMS[self.arm].trained

    @property
    def spec(self) -> EnvironmentSpec:
        """The specification of the surrogate."""
        task, arm, shrink = self.paper_task, ARMS[self.arm], self.scale.shrink
        paper = arm.preset == "paper"
        budget = max(6, (task.budget if paper else task.default_budget) // shrink)
        initial = max(4, task.initial // shrink) if paper else None
        spec = make(task.environment, preset=arm.preset, budget=budget, initial=initial, seed=self.seed).spec()
        return with_choices(spec, dict(arm.design), None)

    @property
    def variations(self) -> tuple[Variation, ...]:
        """The variations for the policy, with the number of episodes of the scale."""
        return tuple(_fewer(v, self.scale.shrink) for v in self.paper_task.variations)


def cells(tasks: Sequence[str], seeds: int, scale: Scale = WHOLE) -> Iterator[Cell]:
    """Every design of every task, seed by seed."""
    for seed in range(seeds):
        for task in tasks:
            for name, arm in ARMS.items():
                if task in arm.tasks:
                    yield Cell(task, name, seed, scale)


def _fewer(variation: Variation, shrink: int) -> Variation:
    if shrink == 1:
        return variation
    return replace(variation, episodes=max(1, variation.episodes // (10 * shrink)))


def _plain(variation: Variation) -> dict[str, Any]:
    """A variation as JSON."""
    start: Any = variation.start
    if isinstance(start, dict):
        start = {name: distribution.model_dump() for name, distribution in start.items()}
    return {**variation.__dict__, "start": start}


def _hash(*depends: Any) -> str:
    return hashlib.sha256(json.dumps([*depends, versions()]).encode()).hexdigest()[:8]
