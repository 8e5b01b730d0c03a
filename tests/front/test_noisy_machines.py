"""Designs of machines with process noise: the noise is found, none is found where there is none, and the rest is
known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from support.changing import MACHINES, Changing
from surrogym import Design

NAMED = {machine.name: machine for machine in MACHINES}


def designed(name: str, noise: float, seed: int, budget: int) -> Design:
    """A design whose queries the machine answers, with noise as a share of each range."""
    machine = replace(NAMED[name], noise=noise)
    original = Changing(machine, machine.real, np.random.default_rng([seed, 5]))
    spec = machine.spec.model_copy(update={"design": machine.spec.design.model_copy(update={"seed": seed})})
    design = Design(spec, budget=budget)
    while (query := design.ask()) is not None:
        design.tell(query, original.step_from(np.array(query.coordinates), np.array(query.action)))
    return design


def noise_of(design: Design) -> list[float]:
    """Established noise of each coordinate, in its range."""
    spans = [coordinate.sampling.high - coordinate.sampling.low for coordinate in design.spec.coordinates]
    outputs = design.fidelity["outputs"]
    assert outputs[-1]["noise"] == 0, "the reward has none"
    return [output["noise"] / span for output, span in zip(outputs[:-1], spans, strict=True)]


def test_a_design_of_a_noise_free_environment_becomes_ready_and_reports_no_noise():
    design = designed("cart", noise=0.0, seed=0, budget=30)
    assert design.phase == "ready"
    assert noise_of(design) == [0, 0]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("name", ["arm", "cart"])
def test_a_design_of_a_noisy_environment_estimates_the_process_noise_and_becomes_ready(name: str, seed: int):
    design = designed(name, noise=0.01, seed=seed, budget=120)
    assert design.phase == "ready"
    assert noise_of(design) == pytest.approx([0.01, 0.01], rel=0.5)


@pytest.mark.parametrize("name", ["arm", "cart", "pole", "mass"])
def test_no_noise_is_estimated_in_a_noise_free_environment(name: str):
    assert not any(noise_of(designed(name, noise=0.0, seed=1, budget=40)))
