"""Dirt is looked for in steps that follow each other, of machines that can only be reset."""

from __future__ import annotations

import numpy as np
import pytest

from support.rail import SPEC
from surrogym_server.convert.dirt import STEPS, dirt_of
from surrogym_server.storage.records import SampleRecord

WIDTH = 0.01  # of the encoder


def record(id: int, trajectory: int | None, step: int, x: float, u: float, x_next: float) -> SampleRecord:
    return SampleRecord(
        *((x,), (u,), (x_next,), 0.0, False),
        id=id,
        purpose="initial",
        sampler="s",
        attempt=1,
        late=False,
        trajectory=trajectory,
        step=step,
        requested_coordinates=None,
        created_at=0.0,
    )


def rolled(rollouts: int, steps: int = 10) -> list[SampleRecord]:
    """Rollouts of a rail with an encoder."""
    rng, records = np.random.default_rng(0), []
    for trajectory in range(rollouts):
        x = rng.uniform(-0.2, 0.2)
        for step in range(steps):
            u = rng.uniform(-1, 1)
            read, x = WIDTH * round(x / WIDTH), x + 0.1 * u
            records.append(record(len(records), trajectory, step, read, u, WIDTH * round(x / WIDTH)))
    return records


def found(samples: list[SampleRecord], **changes: object) -> list[str]:
    return [finding.name for finding in dirt_of(SPEC.model_dump(mode="json") | changes, {}, samples)]


def test_an_encoder_is_found_in_the_first_steps_and_samples_may_come_in_any_order():
    samples = rolled(STEPS // 10)
    assert "encoder" in found(samples)
    assert dirt_of(SPEC.model_dump(mode="json"), {}, samples[::-1]) == dirt_of(
        SPEC.model_dump(mode="json"), {}, samples
    )


def test_a_tolerance_below_the_width_of_an_encoder_is_advised_against_also_if_it_was_set_later():
    samples, spec = rolled(STEPS // 10), SPEC.model_dump(mode="json")
    small, large = (dirt_of(spec, {"x": WIDTH * share}, samples)[0].said for share in (0.9, 1.1))
    assert "declare a tolerance of at least that" in small
    assert "tolerance" not in large


def test_steps_after_a_gap_do_not_count():
    more = rolled(STEPS // 10 + 1)
    assert found([*more[:4], *more[5:STEPS]]) == []
    assert "encoder" in found([*more[:4], *more[5:]]), "the other rollouts have 60 steps"


def test_a_step_that_begins_elsewhere_than_the_last_ended_does_not_count():
    samples = rolled(STEPS // 10)
    samples[3] = record(3, 0, 3, 0.9, 0.0, 0.9)
    assert found(samples) == []


@pytest.mark.parametrize("changes", [{"snapshots": True}, {"query": "step"}])
def test_nothing_is_looked_for_if_queries_may_begin_elsewhere_than_at_a_reset(changes: dict[str, object]):
    assert found(rolled(STEPS // 10), **changes) == []


def test_nothing_is_found_in_no_samples_and_in_samples_of_no_rollout():
    assert found([]) == []
    assert found([record(i, None, 0, 0.01 * i, 0.0, 0.01 * i) for i in range(100)]) == []
