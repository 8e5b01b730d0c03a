"""Settings of one run of a study: a demo with an arm, on a task of any kind."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from surrogym.demo.settings import DemoSettings
from surrogym.demo.tasks import DemoTask, design_budget
from surrogym_lab.arms import ARMS, Arm
from surrogym_lab.tasks import EVERY_TASK
from surrogym_sampler.original import make
from surrogym_sampler.original.loading import has_specification, with_choices
from surrogym_shared.spec import EnvironmentSpec
from surrogym_trainer.training.search import REFERENCE
from surrogym_trainer.training.settings import SUGGESTED_STEPS

if TYPE_CHECKING:
    from surrogym_sampler.original.describing import Description


@dataclass(frozen=True)
class StudySettings(DemoSettings):
    """Settings of a demo, and the arm that chooses its real steps."""

    arm: str = "default"

    @property
    def run_name(self) -> str:
        return self.task if self.arm == "default" else f"{self.task}-{self.arm}"

    @property
    def labels(self) -> dict[str, str]:
        return {"arm": self.arm}

    @property
    def demo_task(self) -> DemoTask:
        return EVERY_TASK[self.task]

    @property
    def way(self) -> Arm:
        return ARMS[self.arm]

    @property
    def virtual_steps(self) -> int | None:
        """Where the default has rounds before its last training, those that have none learn for as long as it may."""
        alone = not self.way.closed_loop and not self.way.original and super().queries_a_round > 0
        return super().virtual_steps or (SUGGESTED_STEPS if alone else None)

    @property
    def search(self) -> str:
        """Name of the policy search. By default, the reference where the paper or the original environment is one side
        of a comparison."""
        if self.algorithm is None and (self.way.original or self.way.preset == "paper"):
            return REFERENCE
        return super().search

    @property
    def prolong(self) -> bool:
        """As in the demo, and not where each step of the training is a real one."""
        return not self.way.original and super().prolong

    @property
    def queries_a_round(self) -> int:
        return super().queries_a_round if self.way.closed_loop else 0

    @property
    def training_options(self) -> list[str]:
        starts = [] if self.way.start_box is None else ["--start-box", str(self.way.start_box)]
        return [*super().training_options, *starts]

    @property
    def description_steps(self) -> int:
        """Real steps that the description of the environment took; 0 with a specification of its own."""
        name = self.demo_task.environment
        return 0 if has_specification(name) else _described(name, self.seed).steps

    def spec(self) -> EnvironmentSpec:
        """The environment's specification with the design of this arm."""
        plain = self._specified(preset=self.way.preset, seed=self.seed)
        budget = design_budget(self.real_steps) if self.way.closed_loop else self.real_steps
        design = self.way.design(budget, len(plain.observation) + plain.action.size)
        return with_choices(plain, design, access=self.way.access)

    def judged_by(self) -> EnvironmentSpec:
        """The original environment as every arm is judged by it, also one that learns another form of it."""
        return self._specified()

    def asked(self) -> dict[str, Any]:
        return super().asked() | {"arm": self.way.fields()}

    def _specified(self, **design: Any) -> EnvironmentSpec:
        """The environment's own specification, or the one that ``surrogym describe`` drafts, with these choices."""
        name = self.demo_task.environment
        drafted = None if has_specification(name) else _described(name, self.seed).spec
        return make(name, spec=drafted, **design).spec()


@cache
def _described(name: str, seed: int) -> Description:
    from surrogym_sampler.original.describing import describe

    return describe(name, seed=seed)
