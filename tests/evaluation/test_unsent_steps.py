"""Real steps in a file are read back to the last bit, and none is set aside, because none can be taken again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from support.rail import SPEC
from surrogym_sampler.logs import UnusableLog, read_log
from surrogym_sampler.logs.importing import Options
from surrogym_shared.logs.writing import npz_of_steps
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import NewSample
from surrogym_trainer.evaluation.reporting import rewrite_steps, write_steps


def steps_from(first: float, count: int = 50) -> list[NewSample]:
    places = first + np.random.default_rng(0).uniform(size=count + 1)
    return [
        NewSample(coordinates=[a], action=[0.5], next_coordinates=[b], reward=-a, terminated=False)
        for a, b in zip(places[:-1].tolist(), places[1:].tolist(), strict=True)
    ]


def named(name: str) -> EnvironmentSpec:
    return EnvironmentSpec.model_validate_json(SPEC.model_dump_json().replace('"x"', f'"{name}"'))


@pytest.mark.parametrize("first", [-0.9, 50.0], ids=["in the sampling range", "far outside, and against its ends"])
def test_real_steps_saved_in_a_file_are_read_back_bit_exactly(tmp_path: Path, first: float):
    """A policy may lead far from the sampling range. A log of unknown origin there would be refused."""
    taken = steps_from(first)
    log = read_log(write_steps(tmp_path / "policy.zip", SPEC, taken), Options(spec=SPEC))
    assert log.rejected == []
    assert log.steps.q.tolist() == [step.coordinates for step in taken]
    assert log.steps.u.tolist() == [step.action for step in taken]
    assert log.steps.q_next.tolist() == [step.next_coordinates for step in taken]
    assert log.reward.tolist() == [step.reward for step in taken]
    assert log.steps.terminated.tolist() == [step.terminated for step in taken]


def test_a_log_of_unknown_origin_is_checked_against_the_sampling_range(tmp_path: Path):
    taken, file = steps_from(50.0), tmp_path / "log.npz"
    fields = ("coordinates", "action", "next_coordinates", "reward", "terminated")
    arrays = {name: np.array([getattr(step, name) for step in taken]) for name in fields}
    file.write_bytes(npz_of_steps(("x",), arrays | {"evaluated": np.zeros(len(taken))}))
    with pytest.raises(UnusableLog, match="half of the log lies between"):
        read_log(file, Options(spec=SPEC))


@pytest.mark.parametrize("name", ["q_0", "obs.left", "next_x", "action_x", "time"])
def test_real_steps_saved_in_a_file_are_read_back_for_any_coordinate_name(tmp_path: Path, name: str):
    """next.q_0 was read as the next value of a state called 0."""
    spec = named(name)
    assert len(read_log(write_steps(tmp_path / "policy.zip", spec, steps_from(0.0)), Options(spec=spec)).steps) == 50


def test_saving_real_steps_to_an_existing_file_replaces_its_content(tmp_path: Path):
    file = write_steps(tmp_path / "policy.zip", SPEC, steps_from(0.0))
    rewrite_steps(file, SPEC, steps_from(0.0)[:3])
    assert len(read_log(file, Options(spec=SPEC)).steps) == 3
    assert list(tmp_path.iterdir()) == [file]
