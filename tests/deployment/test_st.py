"""A controller in structured text decides as its policy does. blark parses it; a small interpreter runs it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("blark")

from support.controllers import holding, limited, network, plant
from support.structured_text import FunctionBlock
from surrogym_shared.spec import MultiDiscreteAction
from surrogym_trainer.deployment.c.files import sensors_of
from surrogym_trainer.deployment.controller import Choices, Controller, NotDeployable
from surrogym_trainer.deployment.reading import controller_of
from surrogym_trainer.deployment.reference import begin, decide
from surrogym_trainer.deployment.st import source_of
from surrogym_trainer.deployment.targets import deploy

PAST = {"changes": 2, "actions": 1, "largest": {"angle": 0.5, "slide": 0.2}, "at_start": {"angle": 0.3}}
STEPS, RESTARTS = 80, (0, 60)


def decided(controller: Controller, real: str) -> list[float]:
    """Run the block beside the reference, with faults; the difference of each command, as a share of its range."""
    block, rng = FunctionBlock(source_of(controller, real, "arm")), np.random.default_rng(0)
    low, high = sensors_of(controller)
    reads = rng.uniform(low, high, (STEPS, len(low))).astype(np.float32).astype(np.float64)
    reads[::40, 0], reads[7::40, 1], reads[13::40] = np.nan, np.inf, high + 1e3
    differences, memory = [], begin(controller)
    for count, read in enumerate(reads):
        restart, age = count in RESTARTS, 9.0 if count % 50 == 49 else 0.0
        memory, action, status = decide(controller, begin(controller) if restart else memory, read[None], age)
        block(measurement=read, age=age, restart=restart)
        assert block.values["status"] == status[0]
        off = np.abs(np.array(block.values["command"], dtype=np.float64) - action[0])
        differences.append(float((off / (controller.high - controller.low)).max()))
    return differences


@pytest.mark.slow
def test_the_structured_text_controller_equals_the_reference_for_lags_limits_and_faults(tmp_path: Path):
    controller = controller_of(network(tmp_path, plant(**PAST), (3,)))
    assert max(decided(controller, "LREAL")) <= 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("real", ["LREAL", "REAL"])
def test_the_structured_text_controller_keeps_limits_and_rates_as_the_reference_does(tmp_path: Path, real: str):
    controller = controller_of(network(tmp_path, limited(plant(**PAST, rate=(20.0, None))), (3,)))
    assert max(decided(controller, real)) <= (1e-6 if real == "LREAL" else 1e-4)
    assert "status := 16" in source_of(controller, real, "arm")


@pytest.mark.slow
@pytest.mark.parametrize("real", ["LREAL", "REAL"])
def test_the_structured_text_controller_sums_errors_as_the_reference_does(tmp_path: Path, real: str):
    policy = network(tmp_path, holding(plant(**PAST)), (3,), settings={"integral": ("slide",)})
    assert max(decided(controller_of(policy), real)) <= (1e-6 if real == "LREAL" else 1e-4)


@pytest.mark.slow
def test_the_32_bit_structured_text_controller_chooses_the_reference_actions(tmp_path: Path):
    spec = plant(MultiDiscreteAction(nvec=(2, 5)))
    controller = controller_of(network(tmp_path, spec, (3,)), choices=Choices(fallback=(1.0, 3.0)))
    differences = np.array(decided(controller, "REAL"))
    assert (differences <= 1e-4).mean() >= 0.98  # two best choices may be equal up to rounding


def test_structured_text_literals_of_both_precisions_have_a_decimal_point(tmp_path: Path):
    controller = controller_of(network(tmp_path, plant(), (64, 64)))
    written = deploy(controller, "st", tmp_path / "st")
    assert [path.name for path in written] == ["arm_controller.st", "arm_controller_real.st"]
    for path, real in zip(written, ("LREAL", "REAL"), strict=True):
        text = path.read_text()
        assert not re.search(r"\d[eE]|inf|nan", re.sub(r"\d+\.\d+E-?\d+|\(\*.*?\*\)", "", text, flags=re.S))
        weights = re.search(rf"WEIGHTS1 : ARRAY\[0\.\.4095\] OF {real} := \[([^]]*)\]", text)
        assert weights is not None
        kind = np.float64 if real == "LREAL" else np.float32
        read = np.array([kind(one) for one in weights[1].split(",")])
        np.testing.assert_array_equal(read, controller.decision.layers[1].weights.ravel().astype(kind))


def test_names_containing_comment_ends_do_not_break_the_structured_text(tmp_path: Path):
    spec = plant()
    first, *others = spec.coordinates
    named = spec.model_copy(update={"coordinates": (first.model_copy(update={"unit": "*) x"}), *others)})
    text = source_of(controller_of(network(tmp_path, named, (3,), model="*) x")), "LREAL", "arm")
    assert text.count("(*") == text.count("*)")


def test_a_structured_text_angle_range_beyond_dint_turns_is_refused(tmp_path: Path):
    choices = Choices(ranges={"angle": (-1e12, 1e12)})
    with pytest.raises(NotDeployable, match="turns"):
        source_of(controller_of(network(tmp_path, plant(), (3,)), choices=choices), "LREAL", "arm")
