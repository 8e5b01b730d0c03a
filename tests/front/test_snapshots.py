"""A design with snapshots that calls itself ready knows the whole sampling range, not only where it has been."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import surrogym
from surrogym_sampler import original
from surrogym_server.environment.points import Points
from surrogym_server.sampling.judging import monte_carlo


def design_of(name: str, seed: int, budget: int) -> surrogym.Design:
    """Run a design that returns to saved states until it ends."""
    machine = original.make(name, access="snapshot", seed=seed, budget=budget)
    design, saved, seeds = surrogym.Design(machine.spec()), {}, np.random.default_rng(seed)
    while (query := design.ask()) is not None:
        if query.snapshot is None:
            machine.begin(int(seeds.integers(2**31)))
        else:
            machine.restore(saved[query.snapshot])
        steps, names = [], []
        for action in query.actions:
            steps.append(machine.act(np.array(action)))
            ended = steps[-1].terminated or steps[-1].truncated
            names.append(None if ended else str(len(saved)))
            if ended:
                break
            saved[names[-1]] = machine.save()
        design.tell(query, steps, names)
    return design


@pytest.mark.parametrize("seed", [63, 113])
def test_a_ready_design_with_snapshots_is_accurate_over_the_whole_sampling_range(seed: int):
    """Beside the bottom the slope of MountainCarContinuous is linear to the third order. Without an excursion these two
    designs were ready after 28 and 27 steps, with speeds that were wrong by 32 tolerances."""
    design = design_of("MountainCarContinuous-v0", seed, 400)
    assert design.phase == "ready"
    model, machine = design.surrogate().model, original.make("MountainCarContinuous-v0")
    points = Points(*monte_carlo(model.definition))[:200]
    real = [machine.step_from(q.numpy(), u.numpy()).next_coordinates for q, u in zip(points.q, points.u, strict=True)]
    errors = (model.transition(points.q, points.u).q_next - torch.tensor(np.array(real))).abs()
    tolerances = torch.tensor([output["tolerance"] for output in design.fidelity["outputs"]][:-1])
    assert ((errors / tolerances).square().mean(0).sqrt() < 1).all()
