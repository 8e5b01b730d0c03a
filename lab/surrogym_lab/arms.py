"""The arms of a comparison: ways to spend the same budget of real steps, and kinds of models.

The default may stop before its budget is spent, also without symmetry or with other starts. Every other arm that learns
a surrogate spends exactly that budget, and learns for as many virtual steps, so that a comparison can only favour it.
Imports only the standard library.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

Acquisition = Literal["variance", "latin_hypercube"]
PAPERS_SHARE = 3  # the paper's initial designs were 40 of 125 and 50 of 120 steps, about a third


@dataclass(frozen=True)
class Arm:
    """One way to spend a budget.

    ``closed_loop``: queries near the visited states, between trainings; without it the design spends the whole budget
    before training. ``start_box``: share of virtual episodes that start anywhere in the range. ``original``: no
    surrogate; the policy search runs in the original environment. ``access``: where queries may begin.
    """

    words: str
    preset: Literal["default", "paper"] = "default"
    acquisition: Acquisition | None = None
    closed_loop: bool = False
    start_box: float | None = None  # None: the default of a training
    original: bool = False
    symmetry: Literal["auto", "none"] = "auto"
    access: Literal["snapshot", "reset"] | None = None  # None: as the specification declares

    def design(self, budget: int, dimensions: int) -> dict[str, Any]:
        """Fields of the specification's design.

        Args:
            budget: real steps of the whole run.
            dimensions: D + F, entries of observation and action.
        """
        chosen: dict[str, Any] = {"preset": self.preset, "budget": budget}
        if self.acquisition is not None:
            chosen["acquisition"] = self.acquisition
        if self.symmetry != "auto":
            chosen["symmetry"] = self.symmetry
        if self.preset == "paper":  # 10 (D + F), section 3.1, would leave nothing to adapt
            chosen["initial"] = max(2, min(10 * dimensions, budget // PAPERS_SHARE))
        return chosen

    def fields(self) -> dict[str, Any]:
        """The fields that define the arm, JSON-able, without choices that only another arm makes."""
        plain = asdict(Arm(self.words))
        return {name: value for name, value in asdict(self).items() if value != plain[name]}


ARMS = {
    "default": Arm("as surrogym demo runs it; it may stop early", closed_loop=True),
    "no_symmetry": Arm("default, not looking for a mirror image", closed_loop=True, symmetry="none"),
    "declared_starts": Arm("default, no virtual episode starts elsewhere", closed_loop=True, start_box=0.0),
    "no_loop": Arm("the whole budget by the design, before training"),
    "variance": Arm("no_loop, each query where the deviation is largest", acquisition="variance"),
    "latin_hypercube": Arm("no_loop, all queries from one Latin hypercube", acquisition="latin_hypercube"),
    "snapshot": Arm("default, queries begin at saved states or resets", closed_loop=True, access="snapshot"),
    "reset": Arm("default, queries begin at resets", closed_loop=True, access="reset"),
    "paper": Arm("the paper's representation, index, reward penalty and initial share", preset="paper"),
    "paper_hypercube": Arm(
        "paper, all queries from one Latin hypercube", preset="paper", acquisition="latin_hypercube"
    ),
    "oracle": Arm("the same PPO in the original environment, each training step a real one", original=True),
}
