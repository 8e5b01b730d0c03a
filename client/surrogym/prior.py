"""A simulator as a prior of a design in this process."""

from __future__ import annotations

import os

import numpy as np

from surrogym.design import Design, Query
from surrogym_sampler.priors.prior import Progress, SimulatorPrior
from surrogym_shared.surrogate_file import SurrogateFile

MOST_THREADS = 4


class Prior(SimulatorPrior):
    """A simulator whose model is learned in this process. Arguments and errors are those of ``SimulatorPrior``.

    Examples:
        >>> prior = surrogym.Prior("textbook:Arm", spec, ["mass=0.5..2", "length"])
        >>> design = surrogym.Design(spec, budget=40, prior=prior)
    """

    def learn(self, say: Progress) -> SurrogateFile:
        design = Design(self.spec, threads=min(MOST_THREADS, os.cpu_count() or 1))
        while (query := design.ask()) is not None:
            self._answer(design, query)
            say(0.5 * design.steps / self.steps, f"{design.steps} of {self.steps} steps of the simulator")
        return design.to_file("prior")

    def _answer(self, design: Design, query: Query) -> None:
        """Take a step of the simulator. One that it can't take is given up."""
        try:
            step = self.simulator.step_from(np.array(query.coordinates), np.array(query.action))
        except Exception:  # any code of a user: the design goes elsewhere
            design.give_up(query)
            return
        numbers = [*np.ravel(step.coordinates), *np.ravel(step.next_coordinates), step.reward]
        if np.isfinite(numbers).all():
            design.tell(query, step)
        else:
            design.give_up(query)
