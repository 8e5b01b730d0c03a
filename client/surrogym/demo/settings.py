"""Settings of one run, and the specification that follows from them."""

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
from surrogym_trainer.training.search import FAST, REFERENCE, SEARCHES
from surrogym_trainer.training.settings import TrainSettings, prolongs


@dataclass(frozen=True)
class DemoSettings:
    """Settings of a demo. None takes the task's own."""

    task: str = "pendulum"
    seed: int = 0
    budget: int | None = None  # real steps
    steps: int | None = None  # virtual steps, all rounds together
    episodes: int = 100
    pictures: bool = True
    keep: bool = False
    algorithm: str | None = None  # name of a policy search; None: the default of a training
    access: Access = "any"  # where a query of the sampler may begin

    @property
    def run_name(self) -> str:
        """Name of the kind of run, for its folder and its table."""
        return self.task if self.access == "any" else f"{self.task}-{self.access}"

    @property
    def labels(self) -> dict[str, str]:
        """What else tells this kind of run from others, for its metrics."""
        return {}

    @property
    def demo_task(self) -> DemoTask:
        return TASKS[self.task]

    @property
    def real_steps(self) -> int:
        """The budget. A task whose states can't be set has the default budget of its specification."""
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
        """Whether a training takes more cycles while it gains: as ``prolongs``, and not if the search can't."""
        return SEARCHES.get(self.search).prolongable and prolongs(TrainSettings(total_steps=self.steps), self.spec())

    @property
    def queries_a_round(self) -> int:
        """Real steps of each round of the closed loop; 0 if there are no rounds."""
        return queries_a_round(self.real_steps)

    @property
    def training_options(self) -> list[str]:
        """Options of ``surrogym train``."""
        options = [] if self.virtual_steps is None else ["--steps", str(self.virtual_steps)]
        if self.algorithm is not None:
            options += ["--algorithm", self.algorithm]
        options.append("--prolong" if self.prolong else "--no-prolong")
        if self.queries_a_round:
            options += ["--improve", str(self.queries_a_round), "--rounds", str(ROUNDS)]
        return options

    @property
    def description_steps(self) -> int:
        """Real steps that the description of the environment took. The demo's tasks have specifications of their
        own."""
        return 0

    def spec(self) -> EnvironmentSpec:
        """The environment's specification with the design of the demo."""
        return with_choices(self._usual, {"preset": "default", "budget": design_budget(self.real_steps)})

    @cached_property
    def _usual(self) -> EnvironmentSpec:
        """The specification with the design's default budget."""
        return make(self.demo_task.environment, preset="default", seed=self.seed, access=self.access).spec()

    def judged_by(self) -> EnvironmentSpec:
        """The original environment as the policy is judged by it."""
        return make(self.demo_task.environment).spec()

    def asked(self) -> dict[str, Any]:
        """Everything that a result depends on and that is known before the run, without the seed; JSON-able."""
        spec = self.spec().model_dump(mode="json")
        spec["design"].pop("seed")
        if not spec["snapshots"]:  # results that are older than snapshots stay valid
            del spec["snapshots"]
        names = ["task", "real_steps", "virtual_steps", "prolong", "episodes"]
        search = {} if self.search == REFERENCE else {"algorithm": self.search.lower()}
        return {"spec": spec, **{name: getattr(self, name) for name in names}, **search}


def fingerprint(content: Any) -> str:
    """Twelve hexadecimal digits for JSON-able content."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:12]
