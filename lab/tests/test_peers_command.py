"""Peers by command: what is finished is shown, and what is not known is refused."""

import pytest

from surrogym_lab.peers.points import BUDGET, Point
from surrogym_lab.peers.study import PeerCell
from surrogym_lab.reproduce.rows import write_records


def test_the_peers_command_shows_finished_results(lab, tmp_path):
    cell = PeerCell("pendulum", "sac", 0)
    point = Point("pendulum", "sac", 0, 1, 20_000, mean=-170.0, episodes=100, ended=BUDGET)
    write_records(cell.file(tmp_path / "out"), Point, [Point(**{**vars(point), "specification": cell.specification})])
    said = lab(
        *("peers", "--tasks=pendulum", "--methods=sac,ppo", "--seeds=1", "--out=out", "--only-table"),
        "--json",
    )
    assert said.code == 0
    assert said.json["unfinished"] == ["pendulum ppo (seeds 0)"]
    assert "not reached by 20,000" in (tmp_path / "out" / "peers.md").read_text()


def test_comparison_results_of_other_settings_are_never_overwritten(lab, tmp_path):
    """Hours of computing would be lost."""
    cell = PeerCell("pendulum", "sac", 0, budget=300)
    point = Point("pendulum", "sac", 0, 1, 300, ended=BUDGET, specification=cell.specification)
    write_records(cell.file(tmp_path / "out"), Point, [point])
    before = cell.file(tmp_path / "out").read_bytes()
    asked = ("peers", "--tasks=pendulum", "--methods=sac", "--seeds=1", "--out=out")
    said = lab(*asked, "--budget=200")
    assert said.code == 1
    assert "out/cells/pendulum-sac-seed0.csv holds a run with other settings" in said.err
    assert "give another --out" in said.err
    assert cell.file(tmp_path / "out").read_bytes() == before
    assert lab(*asked, "--budget=200", "--only-table").code == 0
    assert lab(*asked, "--budget=300").code == 0


def test_the_peers_command_refuses_unknown_methods_and_tasks(lab):
    assert "unknown task 'nothing'" in lab("peers", "--tasks=nothing").err
    assert "unknown method 'x'" in lab("peers", "--methods=x").err


@pytest.mark.parametrize(("task", "words"), [("nomod:Nope", "No module named 'nomod'"), ("mine:Nope", "'Nope'")])
def test_the_peers_command_refuses_a_missing_environment_class_before_running(lab, tmp_path, task, words):
    """It was refused by the process of the first cell, after those of other tasks had begun."""
    (tmp_path / "mine.py").touch()
    said = lab("peers", f"--tasks=pendulum,{task}", "--methods=ppo", "--seeds=1")
    assert said.code == 1
    assert f"expected package.module:factory, got '{task}'" in said.err
    assert words in said.err
    assert "Traceback" not in said.err
    assert not (tmp_path / "runs").exists()


def test_the_peers_command_refuses_methods_that_need_an_unknown_reward_before_running(lab, tmp_path):
    """Its process said so after half a minute, with exit status 0."""
    said = lab("peers", "--tasks=invertedpendulum", "--methods=pets,pilco", "--seeds=1")
    assert said.code == 1
    assert "pets can't learn invertedpendulum: a model-based peer has to know the reward" in said.err
    assert "pilco can't learn invertedpendulum" in said.err
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_the_peers_command_fails_if_no_run_finished(lab, tmp_path):
    (tmp_path / "ending.py").write_text("import os\n\n\ndef ends():\n    os._exit(3)\n")
    said = lab("peers", "--tasks=ending:ends", "--methods=ppo", "--seeds=1", "--out=out")
    assert said.code == 1
    assert "its process ended with exit code 3" in said.out
    assert "none of 1 runs came to its end" in said.err


def test_the_peers_command_refuses_a_missing_result_file(lab, tmp_path):
    """Else the table would lack our runs without a word. Nothing runs before."""
    said = lab("peers", "--tasks=pendulum", "--methods=sac", "--seeds=1", "--rows=none.csv")
    assert said.code == 1
    assert "expected a file of rows, got none.csv, which does not exist" in said.err
    assert not (tmp_path / "runs").exists()


def test_asking_the_peers_command_for_our_method_refers_to_its_result_files(lab):
    """The help names it, so "unknown" would be wrong."""
    said = lab("peers", "--methods=sac,default")
    assert said.code == 1
    assert "default is ours" in said.err
    assert "--rows FILE" in said.err


@pytest.mark.slow
def test_a_comparison_run_stores_its_curve_points_and_is_not_repeated(lab, tmp_path):
    asked = ("peers", "--tasks=pendulum", "--methods=ppo", "--seeds=1", "--out=out", "--budget=64")
    said = lab(*asked, "--episodes=1")
    assert said.code == 0
    assert "1 runs, 0 of them done already" in said.err
    assert "0 of 1 runs, 1 at once" in said.err
    assert "pendulum ppo seed 0: 64 real steps, mean return " in said.err
    assert "| ppo | 1 | 0 of 1 | not reached by 64 |" in said.out
    assert (tmp_path / "out" / "peers.png").exists()
    again = lab(*asked, "--episodes=1")
    assert again.out == said.out
    assert "pendulum ppo" not in again.err
