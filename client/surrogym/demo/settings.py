"""Settings of a demo, and the specification that follows from them."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from surrogym.demo.tasks import ROUNDS, TASKS, DemoTask, design_budget, queries_a_round
from surrogym_sampler.original import make
from surrogym_sampler.original.loading import with_choices
from surrogym_shared.spec import Access, EnvironmentSpec
from surrogym_trainer.training.search import FAST, SEARCHES
from surrogym_trainer.training.settings import TrainSettings, prolongs


@dataclass(frozen=True)
class DemoSettings:
    """Settings of a demo. None takes the default of the task."""

    task: str = "pendulum"
    seed: int = 0
    budget: int | None = None  # most real steps of the design and the rounds together
    steps: int | None = None  # number of virtual steps of all rounds of training together
    episodes: int = 100
    pictures: bool = True
    keep: bool = False
    algorithm: str | None = None  # name of a policy search; None: the default of a training
    access: Access = "any"  # where a query of the sampler may begin

    @property
    def run_name(self) -> str:
        """Name of this kind of run, with which the name of its folder begins."""
        return self.task if self.access == "any" else f"{self.task}-{self.access}"

    @property
    def labels(self) -> dict[str, str]:
        """Further settings that distinguish this kind of run, as entries of its metrics."""
        return {}

    @property
    def demo_task(self) -> DemoTask:
        return TASKS[self.task]

    @property
    def real_steps(self) -> int:
        """Budget of real steps. The default is the task's budget. If ``access`` does not allow any state to be set, the
        default is that of the specification's preset."""
        if self.budget is not None:
            return self.budget
        if self.access == "any":
            return self.demo_task.budget
        spec = self._usual
        return spec.preset.budget(0, len(spec.coordinates), spec.action.size, spec.query == "step")

    @property
    def virtual_steps(self) -> int | None:
        """Virtual steps of all rounds together; None derives them from the specification."""
        return self.steps

    @property
    def search(self) -> str:
        """Name of the policy search."""
        return FAST if self.algorithm is None else SEARCHES.name_of(self.algorithm)

    @property
    def prolong(self) -> bool:
        """Whether the training is prolonged while the return still rises. This requires that the policy search supports
        it, that no number of virtual steps is given, and that the preset is not ``paper``."""
        return SEARCHES.get(self.search).prolongable and prolongs(TrainSettings(total_steps=self.steps), self.spec())

    @property
    def queries_a_round(self) -> int:
        """Real steps of each round of the closed loop; 0 if there are no rounds."""
        return queries_a_round(self.real_steps)

    @property
    def training_options(self) -> list[str]:
        """Options of ``surrogym train`` for the training of this demo."""
        options = [] if self.virtual_steps is None else ["--steps", str(self.virtual_steps)]
        if self.algorithm is not None:
            options += ["--algorithm", self.algorithm]
        options.append("--prolong" if self.prolong else "--no-prolong")
        if self.queries_a_round:
            options += ["--improve", str(self.queries_a_round), "--rounds", str(ROUNDS)]
        return options

    @property
    def description_steps(self) -> int:
        """Number of real steps by which the environment's specification was drafted; 0, as the demo's tasks have
        specifications."""
        return 0

    def spec(self) -> EnvironmentSpec:
        """Return the environment's specification with the budget of this demo."""
        return with_choices(self._usual, {"preset": "default", "budget": design_budget(self.real_steps)})

    @cached_property
    def _usual(self) -> EnvironmentSpec:
        """Specification of the task's environment with the default budget."""
        return make(self.demo_task.environment, preset="default", seed=self.seed, access=self.access).spec()

    def judged_by(self) -> EnvironmentSpec:
        """Return the specification of the original environment by which the policy is evaluated."""
        return make(self.demo_task.environment).spec()

    def asked(self) -> dict[str, Any]:
        """Return all settings that a result depends on, except the seed, as values that JSON can represent."""
        spec = self.spec().model_dump(mode="json")
        spec["design"].pop("seed")
        names = ["task", "real_steps", "virtual_steps", "prolong", "episodes"]
        return {"spec": spec, **{name: getattr(self, name) for name in names}, "algorithm": self.search.lower()}


def fingerprint(content: Any) -> str:
    """Return a hash of content that JSON can represent, as twelve hexadecimal digits."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:12]
