"""A simulator as the prior (a model of what is known beforehand) of a design in this process."""

from __future__ import annotations

import os

import numpy as np

from surrogym.design import Design
from surrogym_sampler.original.errors import StepRefused
from surrogym_sampler.priors.prior import Careful, Progress, SimulatorPrior
from surrogym_shared.surrogate_file import SurrogateFile

MOST_THREADS = 4


class Prior(SimulatorPrior):
    """Prior of a design: a model of a simulator, which is learned in this process. Arguments and errors are those of
    ``SimulatorPrior``.

    Examples:
        >>> prior = surrogym.Prior("textbook:Arm", spec, ["mass=0.5..2", "length"])
        >>> design = surrogym.Design(spec, budget=40, prior=prior)
    """

    def learn(self, say: Progress) -> tuple[SurrogateFile, float]:
        design, simulator = Design(self.spec, threads=min(MOST_THREADS, os.cpu_count() or 1)), Careful(self.simulator)
        while (query := design.ask()) is not None:
            try:
                design.tell(query, simulator.step_from(np.array(query.coordinates), np.array(query.action)))
            except StepRefused:
                design.give_up(query)
            say(0.5 * design.steps / self.steps, f"{design.steps} of {self.steps} steps of the simulator")
        return design.to_file("prior"), design.fidelity["confidence_index"]
