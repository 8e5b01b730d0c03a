"""A controller as an FMU passes the checks of FMI and decides as its policy does, at once and once in each period."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu

from support.controllers import network, plant
from support.steps_in_c import needs_compiler
from support.twins import opened
from surrogym_shared.fmu import Block, Variable
from surrogym_trainer.deployment.c.files import sensors_of
from surrogym_trainer.deployment.controller import Choices, NotDeployable
from surrogym_trainer.deployment.reading import controller_of
from surrogym_trainer.deployment.reference import begin, decide
from surrogym_trainer.deployment.targets import deploy

pytestmark = needs_compiler
PERIOD, ACTIONS = 0.05, ("action_0", "action_1")


def test_a_controller_fmu_gives_the_reference_actions_and_the_fallback_action_on_faults(tmp_path: Path):
    history = plant(changes=2, actions=2, largest={"angle": 0.5, "slide": 0.2}, at_start={"angle": 0.3})
    controller = controller_of(network(tmp_path, history, (8,)))
    (path,) = deploy(controller, "fmu", tmp_path / "out")
    assert validate_fmu(str(path)) == []
    low, high = sensors_of(controller)
    reads = np.random.default_rng(0).uniform(low, high, (40, len(low)))
    reads[10, 0], reads[20, 1] = np.nan, high[1] + 1
    memory, names = begin(controller), [one.name for one in controller.measurements]
    with opened(path) as one:
        one.begin()
        assert one.get(*ACTIONS) == controller.fallback.tolist()
        for count, read in enumerate(reads):
            age = 1.0 if count == 30 else 0.0
            memory, action, status = decide(controller, memory, read[None], age)
            one.step(count * PERIOD, PERIOD, age=age, **dict(zip(names, map(float, read), strict=True)))
            np.testing.assert_allclose(one.get(*ACTIONS), action[0], rtol=0, atol=1e-9)
            assert one.get("status") == [status[0]]
    assert deploy(controller, "fmu", tmp_path / "out") == [path]  # the same bytes


def test_a_controller_fmu_holds_its_action_until_the_next_period(tmp_path: Path):
    controller = controller_of(network(tmp_path, plant(), (8,)))
    (path,) = deploy(controller, "fmu", tmp_path / "out")
    with opened(path) as one:
        one.begin()
        one.step(0.0, PERIOD / 4, slide=0.5)
        first = one.get(*ACTIONS)
        for quarter in (1, 2, 3):
            one.step(quarter * PERIOD / 4, PERIOD / 4, slide=1.5)
            assert one.get(*ACTIONS) == first
        one.step(PERIOD, PERIOD / 4)
        assert one.get(*ACTIONS) != first


def test_deploying_a_controller_fmu_without_a_period_is_refused(tmp_path: Path):
    spec = plant().model_copy(update={"sampling_period": None})
    with pytest.raises(NotDeployable, match="--period"):
        deploy(controller_of(network(tmp_path, spec, (8,))), "fmu", tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(NotDeployable, match="--period"):
        deploy(controller_of(network(tmp_path, spec, (8,))), "arduino", tmp_path / "out")
    controller = controller_of(network(tmp_path, spec, (8,)), choices=Choices(period=0.1))
    assert (controller.period, controller.timeout) == (0.1, 0.2)
    with pytest.raises(NotDeployable, match="that the specification declares"):
        controller_of(network(tmp_path, plant(), (8,)), choices=Choices(period=0.1))


def test_a_controller_fmu_supports_measurement_names_with_special_characters(tmp_path: Path):
    odd = 'a"b\\c??/ 😀'
    spec = plant()
    named = type(spec).model_validate_json(spec.model_dump_json().replace('"slide"', json.dumps(odd)))
    (path,) = deploy(controller_of(network(tmp_path, named, (8,))), "fmu", tmp_path / "out")
    with opened(path, said := []) as one:
        with pytest.raises(FMICallException):
            one.step(0.0, PERIOD, **{odd: 0.5})
        assert "initialised" in said[0]
        one.begin()
        one.step(0.0, PERIOD, **{odd: 0.5})
        assert one.get("status") == [0.0]


def test_an_fmu_measurement_named_time_or_with_control_characters_is_refused():
    for name in ("time", "a\nb"):
        with pytest.raises(ValueError, match=r"time|control characters"):
            Block("b", "", (Variable(name, "Float64", "input", 0.0),), 1.0, None, {})
