"""Settings of one run, and the specification that follows from them."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from surrogym_client.experiments.arms import ARMS, Arm
from surrogym_client.experiments.tasks import EVERY_TASK, DemoTask, design_budget, queries_a_round
from surrogym_client.original import make
from surrogym_client.original.loading import has_specification, with_choices
from surrogym_client.training.search import FAST, REFERENCE, SEARCHES
from surrogym_client.training.settings import SUGGESTED_STEPS, TrainSettings, prolongs
from surrogym_shared.spec import EnvironmentSpec

if TYPE_CHECKING:
    from surrogym_client.original.describing import Description


@dataclass(frozen=True)
class DemoSettings:
    """Settings of a demo. None takes the task's own."""

    task: str = "pendulum"
    seed: int = 0
    arm: str = "default"
    budget: int | None = None  # real steps
    steps: int | None = None  # virtual steps, all rounds together
    episodes: int = 100
    pictures: bool = True
    keep: bool = False
    algorithm: str | None = None  # name of a policy search; None: see ``search``

    @property
    def demo_task(self) -> DemoTask:
        return EVERY_TASK[self.task]

    @property
    def way(self) -> Arm:
        return ARMS[self.arm]

    @property
    def real_steps(self) -> int:
        """The budget."""
        return self.budget or self.demo_task.budget

    @property
    def virtual_steps(self) -> int | None:
        """Where the default has rounds before its last training, those that have none learn for as long as it may."""
        alone = not self.way.closed_loop and not self.way.original and queries_a_round(self.real_steps) > 0
        return self.steps or self.demo_task.steps or (SUGGESTED_STEPS if alone else None)

    @property
    def search(self) -> str:
        """Name of the policy search. By default, the reference where the paper or the original environment is one side
        of a comparison."""
        if self.algorithm is not None:
            return SEARCHES.name_of(self.algorithm)
        return REFERENCE if self.way.original or self.way.preset == "paper" else FAST

    @property
    def prolong(self) -> bool:
        """Whether a training that still gains takes as many virtual steps again: as ``prolongs`` where a task or an arm
        chose their number, and not where each is a real one or the search can't be prolonged."""
        if not SEARCHES.get(self.search).prolongable:
            return False
        return not self.way.original and prolongs(TrainSettings(total_steps=self.steps), self.spec())

    def spec(self) -> EnvironmentSpec:
        """The environment's specification with the design of this arm."""
        plain = self._specified(preset=self.way.preset, seed=self.seed)
        budget = design_budget(self.real_steps) if self.way.closed_loop else self.real_steps
        design = self.way.design(budget, len(plain.observation) + plain.action.size)
        return with_choices(plain, design, access=self.way.access)

    def judged_by(self) -> EnvironmentSpec:
        """The original environment as every arm is judged by it, also one that learns another form of it."""
        return self._specified()

    @property
    def description_steps(self) -> int:
        """Real steps that the description of the environment took; 0 with a specification of its own."""
        name = self.demo_task.environment
        return 0 if has_specification(name) else _described(name, self.seed).steps

    def _specified(self, **design: Any) -> EnvironmentSpec:
        """The environment's own specification, or the one that ``surrogym describe`` drafts, with these choices."""
        name = self.demo_task.environment
        drafted = None if has_specification(name) else _described(name, self.seed).spec
        return make(name, spec=drafted, **design).spec()

    def asked(self) -> dict[str, Any]:
        """Everything that a result depends on and that is known before the run, without the seed; JSON-able."""
        spec = self.spec().model_dump(mode="json")
        spec["design"].pop("seed")
        if not spec["snapshots"]:  # results that are older than snapshots stay valid
            del spec["snapshots"]
        names = ["task", "real_steps", "virtual_steps", "prolong", "episodes"]
        search = {} if self.search == REFERENCE else {"algorithm": self.search.lower()}
        return {"spec": spec, "arm": self.way.fields(), **{name: getattr(self, name) for name in names}, **search}


@cache
def _described(name: str, seed: int) -> Description:
    from surrogym_client.original.describing import describe

    return describe(name, seed=seed)


def fingerprint(content: Any) -> str:
    """Twelve hexadecimal digits for JSON-able content."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:12]
