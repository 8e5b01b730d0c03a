"""Which row continues which, for drawn logs whose truth is known: all steps and no wrong one, or a refusal."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest

from surrogym_shared.logs.columns import roles_by_name
from surrogym_shared.logs.rows import rows_of
from surrogym_shared.logs.table import Floats, Ints, Table, UnusableLog
from surrogym_shared.logs.transitions import Transitions, transitions_of

DRAWS = range(20)


@dataclass(frozen=True)
class Plant:
    """A plant under a sensor that rounds, so that most of its rows equal the row before."""

    x: Floats  # (n,)
    u: Floats  # (n,)

    @classmethod
    def drawn(cls, rng: np.random.Generator, rows: int) -> Plant:
        u = np.repeat(rng.integers(-1, 2, rows), rng.integers(1, 30))[:rows].astype(float)
        return cls(np.round(np.cumsum(0.1 * rng.random() * u), 1), u)

    def __len__(self) -> int:
        return len(self.x)

    def log(self, rows: Ints, **columns) -> Transitions:
        """The steps of a log that holds these rows of the plant, beside other columns."""
        cells = {"x": self.x[rows], "action_u": self.u[rows], "reward": -np.abs(self.x[rows])} | columns
        table = Table(cells, np.arange(2, 2 + len(rows)))
        return transitions_of(rows_of(table, roles_by_name(table.names)))

    def wrong(self, steps: Transitions, rows: Ints, last: Ints) -> int:
        """Number of the steps that don't lead to the plant's next row. Rows ``last`` have none."""
        at = rows[steps.row]
        after = np.minimum(at + 1, len(self) - 1)
        return int((np.isin(at, last) | (steps.q_next[:, 0] != self.x[after])).sum())


def drawn() -> Iterator[tuple[np.random.Generator, Plant]]:
    for seed in DRAWS:
        rng = np.random.default_rng(seed)
        yield rng, Plant.drawn(rng, int(rng.integers(40, 400)))


def test_identical_log_rows_without_a_time_column_are_all_kept_as_steps():
    """Equal rows were dropped as repeats, and their neighbours joined: 29 of 599 steps were left, 21 of them wrong."""
    for _, plant in drawn():
        rows = np.arange(len(plant))
        steps = plant.log(rows)
        assert (len(steps), steps.ends, steps.rejected) == (len(plant) - 1, 1, {})
        assert plant.wrong(steps, rows, rows[-1:]) == 0


def test_identical_log_rows_within_an_episode_are_all_kept_as_steps():
    for rng, plant in drawn():
        rows, episode = np.arange(len(plant)), np.arange(len(plant)) // int(rng.integers(5, 20))
        steps, last = plant.log(rows, episode=episode), np.flatnonzero(np.diff(episode, append=-1))
        assert (len(steps), steps.rejected) == (len(plant) - len(last), {})
        assert plant.wrong(steps, rows, last) == 0


def test_log_rows_repeated_at_the_same_time_are_set_aside():
    for rng, plant in drawn():
        rows = np.repeat(np.arange(len(plant)), 1 + (rng.random(len(plant)) < rng.random()))
        steps = plant.log(rows, time=rows * 0.5)
        assert len(steps) == len(plant) - 1
        assert len(steps.rejected) == len(rows) - len(plant)
        assert plant.wrong(steps, rows, rows[-1:]) == 0


def test_a_log_concatenated_with_itself_gives_each_step_once():
    for rng, plant in drawn():
        copies = int(rng.integers(2, 4))
        rows = np.tile(np.arange(len(plant)), copies)
        steps = plant.log(rows, time=rows * 0.5)
        assert (len(steps), len(steps.rejected)) == (len(plant) - 1, (copies - 1) * len(plant))
        assert plant.wrong(steps, rows, rows[-1:]) == 0


def test_equal_episodes_within_a_log_all_give_samples():
    """A machine that is reset and does the same writes equal rows, which are not repeats."""
    for rng, plant in drawn():
        length = len(plant)
        other = np.r_[np.arange(length), np.arange(length), np.arange(length // 2)]
        steps = plant.log(other, time=other * 0.5)
        assert (len(steps), steps.rejected) == (len(other) - 3, {})
        assert len(steps.notes) == 1, "the new episodes are named"
        named = np.repeat(rng.permutation(3), [length, length, length // 2])
        assert len(plant.log(other, time=other * 0.5, episode=named)) == len(other) - 3


def test_rows_sharing_a_coarse_time_stamp_are_all_used_in_order():
    """Rows of one time were set aside, and the first rows of two times joined."""
    for rng, plant in drawn():
        rows, each = np.arange(len(plant)), float(rng.uniform(2, 12))
        plant = Plant(plant.x + 0.01 * rng.random(len(plant)), plant.u)
        for tick in (each, round(each)):
            steps = plant.log(rows, time=np.floor(rows / tick))
            assert (len(steps), steps.rejected) == (len(plant) - 1, {})
            assert plant.wrong(steps, rows, rows[-1:]) == 0
            assert steps.interval == pytest.approx(1 / tick, rel=0.3)
            assert len(steps.notes) == 1


def test_rows_missing_from_a_coarsely_timed_log_give_no_wrong_step():
    seen = []
    for rng, plant in drawn():
        plant = Plant(plant.x + 0.01 * rng.random(len(plant)), plant.u)
        each = int(rng.integers(5, 12))
        whole = len(plant) // each - 2  # what lacks at the first or last time can't be told from a later begin or end
        lost = 1 + rng.choice(whole, max(1, int(rng.integers(0, whole // 2))), replace=False)
        kept = ~np.isin(np.arange(len(plant)), (lost[:, None] * each + np.arange(2, 4)).ravel())
        rows = np.flatnonzero(kept)
        try:
            steps = plant.log(rows, time=np.floor(rows / each))
        except UnusableLog as error:
            seen.append(str(error))
            continue
        assert plant.wrong(steps, rows, rows[-1:]) == 0, "no step across what is missing"
        assert len(steps) > 0.75 * len(rows)
    assert 0 < len(seen) < len(DRAWS)
    assert all("rows may be missing" in refusal for refusal in seen)


def test_concatenated_log_files_become_separate_episodes():
    for rng, plant in drawn():
        cut = int(rng.integers(5, len(plant) - 5))
        rows = np.r_[np.arange(cut, len(plant)), np.arange(cut)]
        last = np.array([cut - 1, len(plant) - 1])
        for stamps in (rows * 0.5, rows - np.where(rows >= cut, cut, 0)):  # one clock, or one from 0 in each file
            steps = plant.log(rows, time=stamps)
            assert (len(steps), steps.rejected) == (len(plant) - 2, {})
            assert plant.wrong(steps, rows, last) == 0
            assert "a new episode begins there" in steps.notes[0]


def test_rows_shared_by_overlapping_log_files_count_once():
    for rng, plant in drawn():
        cut = int(rng.integers(10, len(plant) - 5))
        shared = int(rng.integers(3, cut - 3))
        rows = np.r_[np.arange(cut), np.arange(cut - shared, len(plant))]
        steps = plant.log(rows, time=rows * 0.5)
        assert len(steps.rejected) == shared
        assert len(plant) - 2 <= len(steps) < len(plant)
        assert plant.wrong(steps, rows, np.array([cut - 1, len(plant) - 1])) == 0


def test_a_returning_episode_name_starts_another_episode():
    for rng, plant in drawn():
        length = int(rng.integers(4, 8))
        rows = np.arange(len(plant) // (4 * length) * 4 * length)
        steps = plant.log(rows, episode=rows // length % 2 + 2 * (rows < len(rows) // 2))
        last = np.arange(length - 1, len(rows), length)
        assert (len(steps), steps.rejected) == (len(rows) - len(last), {})
        assert plant.wrong(steps, rows, last) == 0
        assert len(rows) == 4 * length or "returned after other episodes" in steps.notes[0]


def test_interleaved_rows_of_several_episodes_are_separated():
    for rng, plant in drawn():
        lanes = int(rng.integers(2, 5))
        length = len(plant) // lanes
        rows = np.arange(lanes * length).reshape(lanes, length).T.ravel()
        steps, last = plant.log(rows, episode=rows // length), np.arange(length - 1, lanes * length, length)
        assert (len(steps), steps.rejected) == (len(rows) - lanes, {})
        assert plant.wrong(steps, rows, last) == 0
