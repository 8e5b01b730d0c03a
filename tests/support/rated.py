"""A rail whose drive changes its push by at most 0.5 in a step, and notes each push."""

from __future__ import annotations

from support.rail import SPEC, Rail
from surrogym_shared.spec import EnvironmentSpec, with_history

CHANGE = 0.5
PERIOD = 0.1
RATED = with_history(
    EnvironmentSpec.model_validate({**SPEC.model_dump(), "sampling_period": PERIOD}),
    actions=1,
    rate=(CHANGE / PERIOD,),
)


class RatedRail(Rail):
    parallel = True

    def __init__(self) -> None:
        super().__init__()
        self.pushes: list[float] = []

    def spec(self):
        return RATED

    def step(self, action):
        self.pushes.append(float(action[0]))
        return super().step(action)
