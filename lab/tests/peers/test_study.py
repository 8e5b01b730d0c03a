"""A finished cell is not run again, a failed one is, and every cell says why it ended."""

import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from surrogym_lab.peers import registry
from surrogym_lab.peers.methods.model_free import goals
from surrogym_lab.peers.points import BUDGET, REACHED, TIME
from surrogym_lab.peers.port import NotApplicable
from surrogym_lab.peers.registry import METHODS, Method, task_of
from surrogym_lab.peers.study import PeerCell, run_cell
from surrogym_trainer.policies.predict import PerEpisode


class Balancing:
    """Pushes the cart below the falling pole. Its first round does the opposite."""

    def learn(self, real, seed) -> Iterator:
        for sign in (-1, 1, 1):
            real.reset()
            for _ in range(5):
                real.step(np.zeros(1))
            yield lambda seen, sign=sign: (sign * (seen[:, 2] + 0.3 * seen[:, 3]) > 0).astype(float)


class Refusing:
    def learn(self, real, seed) -> Iterator:
        real.reset()
        raise NotApplicable("not this one")
        yield


@pytest.fixture
def peers(monkeypatch):
    for name, peer in (("balancing", Balancing), ("refusing", Refusing)):
        monkeypatch.setitem(METHODS, name, Method(name, peer, budget=100))


def test_a_comparison_run_ends_with_the_round_that_reaches_the_target(peers, tmp_path):
    cell = PeerCell("cartpole", "balancing", 0, episodes=3)
    points = run_cell(cell, tmp_path)
    assert [(p.round, p.real_steps, p.ended) for p in points] == [(1, 5, ""), (2, 10, REACHED)]
    assert points[0].mean < 50 < points[1].min == 500
    assert [p.ended for p in cell.points(tmp_path)] == ["", REACHED]
    assert cell.done(tmp_path)
    assert not PeerCell("cartpole", "balancing", 0, episodes=2).done(tmp_path)  # other settings


def test_a_comparison_run_with_an_empty_result_file_counts_as_not_run(peers, tmp_path):
    """One such file, as a full disk leaves it, blocked every cell of the study."""
    cell = PeerCell("cartpole", "balancing", 0, episodes=3)
    cell.file(tmp_path).parent.mkdir()
    cell.file(tmp_path).touch()
    assert (cell.points(tmp_path), cell.occupied(tmp_path), cell.done(tmp_path)) == ([], False, False)


def test_a_comparison_run_with_changed_method_settings_is_repeated(peers, monkeypatch):
    class Tuned(Balancing):
        def __init__(self, gain: float) -> None:
            self.gain = gain

    found = []
    for gain in (0.3, 0.3, 0.5):
        monkeypatch.setitem(METHODS, "balancing", Method("", lambda gain=gain: Tuned(gain), budget=100))
        found.append(PeerCell("cartpole", "balancing", 0).specification)
    assert found[0] == found[1] != found[2]


def test_a_comparison_run_ends_at_its_step_budget_even_within_a_round(peers, tmp_path):
    points = run_cell(PeerCell("cartpole", "balancing", 0, budget=7, episodes=1), tmp_path)
    assert [(p.round, p.real_steps, p.ended) for p in points] == [(1, 5, ""), (2, 7, BUDGET)]
    assert points[0].mean == points[1].mean


def test_a_comparison_run_that_exceeds_its_time_limit_reports_it(peers, tmp_path):
    (point,) = run_cell(PeerCell("cartpole", "balancing", 0, minutes=-1.0), tmp_path)
    assert (point.ended, point.mean) == (TIME, None)


def test_a_compared_method_that_refuses_a_task_stores_its_reason_and_can_be_run_again(peers, tmp_path):
    cell = PeerCell("cartpole", "refusing", 0)
    (point,) = run_cell(cell, tmp_path)
    assert point.ended == "NotApplicable: not this one"
    assert not cell.done(tmp_path)


def test_the_step_budget_of_compared_methods_is_ten_times_that_of_surrogym_and_at_least_1000():
    method = Method("", Balancing)
    assert [method.real_steps(registry.EVERY_TASK[name]) for name in ("pendulum", "doublependulum")] == [1_000, 2_000]


def test_a_user_environment_can_be_a_task_for_compared_methods_without_a_target():
    assert task_of("cart:Cart").environment == "cart:Cart"
    with pytest.raises(KeyError):
        task_of("nothing")
    with pytest.raises(KeyError):
        task_of("dm-pendulum")  # it has no specification of its own


def test_rounds_of_model_free_methods_end_at_fixed_step_counts():
    assert goals(20_000) == [1_000, 2_000, 5_000, 10_000, 20_000]
    assert goals(700) == [700]


class Forgetful(PerEpisode):
    """Balances in its first 500 steps of an episode, and not after them, as a policy does that remembers an evaluation
    before this one."""

    def __init__(self) -> None:
        self.steps: dict[int, int] = {}

    def actions(self, episodes, observations):
        self.steps |= {number: self.steps.get(number, 0) + 1 for number in episodes}
        sign = np.array([1 if self.steps[number] <= 500 else -1 for number in episodes])
        return (sign * (observations[:, 2] + 0.3 * observations[:, 3]) > 0).astype(float)[:, None]


def test_a_controller_with_memory_is_reset_between_evaluations(monkeypatch, tmp_path):
    class Learned:
        def learn(self, real, seed):
            real.reset()
            real.step(np.zeros(1))
            yield Forgetful()

    monkeypatch.setitem(METHODS, "remembering", Method("", Learned, budget=100))
    (point,) = run_cell(PeerCell("cartpole", "remembering", 0, episodes=2), tmp_path)
    assert point.ended == REACHED


def test_a_comparison_run_uses_one_thread_in_every_library():
    """SciPy's own BLAS loads with the methods. Its second thread would wait by spinning, and the wait would count."""
    code = """
from surrogym_lab.peers import study
study._single_thread()
import scipy.linalg
from threadpoolctl import threadpool_info
print(sorted({pool["num_threads"] for pool in threadpool_info()}))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[1]\n"
