"""Peers in a real Ray cluster of this machine: points come back, and a method that breaks ends its own cell alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from surrogym_client.experiments.peers import on_ray
from surrogym_client.experiments.peers.points import TIME, Point
from surrogym_client.experiments.peers.registry import METHODS, Method
from surrogym_client.experiments.peers.study import PeerCell, run_cell
from surrogym_client.runtime.ray_cluster import connect

ray = pytest.importorskip("ray")

pytestmark = [pytest.mark.timeout(600), pytest.mark.filterwarnings("ignore::FutureWarning:ray")]


def test_cells_run_in_the_cluster_and_leave_the_same_as_here(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The method ``here`` is known to this process alone, so its cell breaks in the cluster."""
    connect(address)
    cells = [PeerCell("cartpole", "ppo", seed, episodes=1, minutes=-1.0) for seed in range(2)]
    monkeypatch.setitem(METHODS, "here", Method("here", METHODS["ppo"].make, budget=100))
    broken = PeerCell("cartpole", "here", 0)
    told: dict[PeerCell, Sequence[Point]] = {}
    on_ray.run_cells([broken, *cells], tmp_path / "there", 2, told.__setitem__)
    assert told.keys() == {broken, *cells}
    for cell in cells:
        here = run_cell(cell, tmp_path / "here")
        assert [here[-1].ended] == [TIME]
        assert [replace(point, cpu_seconds=None) for point in cell.points(tmp_path / "there")] == [
            replace(point, cpu_seconds=None) for point in here
        ]
        assert cell.done(tmp_path / "there")
    [point] = broken.points(tmp_path / "there")
    assert point.ended == "KeyError: 'here'"
    assert not broken.done(tmp_path / "there")
