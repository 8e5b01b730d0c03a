"""Section 5 of the paper, made again: what is varied is what is said, stages resume, numbers are what they claim."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from surrogym_lab.reproduce.paper_cases import QUICK, TASKS, WHOLE, Cell, Variation, cells
from surrogym_lab.reproduce.paper_measures import BiasedEpisode, Unseen, run_variation, some
from surrogym_lab.reproduce.paper_table import settling_time, table
from surrogym_lab.reproduce.table import markdown
from surrogym_sampler.original import make
from surrogym_shared.spec import Fixed


def test_reproduced_designs_have_the_papers_numbers_of_real_steps():
    designs = {(c.task, c.arm): c.spec.design for c in cells(list(TASKS), 1)}
    assert (designs["pendulum", "paper"].initial, designs["pendulum", "paper"].budget) == (40, 125)
    assert (designs["cartpole", "paper"].initial, designs["cartpole", "paper"].budget) == (50, 120)
    assert designs["pendulum", "hypercube"] == designs["pendulum", "paper"].model_copy(
        update={"acquisition": "latin_hypercube"}
    )
    assert designs["pendulum", "printed"].tolerance is None  # the preset's own, raw
    assert designs["pendulum", "default"].budget == 14
    assert ("cartpole", "hypercube") not in designs


def test_the_name_of_a_paper_study_run_contains_all_its_settings():
    one = Cell("pendulum", "paper", 0)
    longer = replace(one, scale=replace(WHOLE, steps=1_000))
    assert one.name == Cell("pendulum", "paper", 0).name == longer.name
    assert one.policy_name != longer.policy_name  # the same design serves both
    assert len({one.name, replace(one, seed=1).name, replace(one, scale=QUICK).name}) == 3


@pytest.mark.parametrize(("upward", "least"), [(True, 1.0), (False, 0.05)])
def test_a_biased_environment_varies_only_the_named_quantities(upward, least):
    variation = Variation("any", 1, {"theta": Fixed(value=1.0), "speed": Fixed(value=0.5)}, ("m",), 0.5, upward)
    spec = make("Pendulum-v1").spec().model_copy(update={"start": variation.start})
    masses = []
    for seed in range(20):
        episode = BiasedEpisode(spec, variation)
        assert episode.reset(seed).coordinates.tolist() == [1.0, 0.5]
        masses.append(episode._env.m)
        assert (episode._env.g, episode._env.l, episode._env.max_torque) == (10.0, 1.0, 2.0)
    assert least <= min(masses) < 1.1
    assert len(set(masses)) == 20
    assert min(masses) < 1 or upward


def test_in_a_biased_environment_a_full_action_gives_the_full_torque():
    variation = Variation(
        "any", 1, {"theta": Fixed(value=0.0), "speed": Fixed(value=0.0)}, ("max_torque",), limit="max_torque"
    )
    episode = BiasedEpisode(make("Pendulum-v1").spec().model_copy(update={"start": variation.start}), variation)
    episode.reset(5)
    episode.step(np.array([-2.0]))
    assert episode._env.last_u == pytest.approx(-episode._env.max_torque)
    assert abs(episode._env.last_u + 2.0) > 1e-3


def test_a_biased_mass_also_changes_the_quantities_derived_from_it():
    variation = Variation("any", 1, None, ("masspole",), 0.5)
    episode = BiasedEpisode(make("CartPole-v1").spec(), variation)
    episode.reset(3)
    assert episode._env.total_mass == episode._env.masscart + episode._env.masspole != 1.1


def test_episodes_of_the_paper_study_are_counted_traced_and_reproducible():
    spec = make("Pendulum-v1").spec().model_copy(update={"time_limit": 5})

    def still(observations):
        return np.zeros((len(observations), 1), dtype=np.float32)

    traced = run_variation(still, spec, Variation("any", 3, "anywhere", traced=True))
    assert (traced["steps"], len(traced["traces"])) == (15, 3)
    plain = run_variation(still, spec, Variation("any", 3, "anywhere"))
    assert plain["returns"] == traced["returns"]
    assert [t["coordinates"][0] for t in traced["traces"]] == plain["starts"]
    for trace, returned in zip(traced["traces"], plain["returns"], strict=True):
        assert sum(trace["reward"]) == pytest.approx(returned)


def test_every_model_of_the_paper_study_is_tested_on_the_same_unseen_steps():
    spec = make("CartPole-v1", preset="paper").spec()
    one, same = Unseen(spec, 8), Unseen(spec, 8)
    assert (one.coordinates, one.action, one.reward.tolist()) == (same.coordinates, same.action, same.reward.tolist())
    assert set(one.reward) == {0.0, 1.0}


def test_models_chosen_for_evaluation_are_evenly_spaced_from_first_to_last():
    assert some(list(range(80)), 5) == [0, 20, 40, 59, 79]
    assert some([1, 2], 5) == [1, 2]


@pytest.mark.parametrize(
    ("angles", "seconds"), [([3.0, 2.0, 0.1, 0.0], 0.1), ([0.0, 3.0, 0.0], 0.1), ([0.1, 0.1], 0.0), ([0.0, 3.0], None)]
)
def test_the_pole_counts_as_settled_once_it_stays_upright(angles, seconds):
    assert settling_time([[angle, 0.0] for angle in angles]) == seconds


def test_a_paper_study_run_counts_only_if_all_its_trials_are_complete():
    def row(seed, lengths):
        episodes = {v.name: {"lengths": lengths} for v in TASKS["cartpole"].variations}
        told = {"reward": 0.7, "reward_printed": math.pi}
        design = {"initial": 50, "adaptive": 70, "confidence": [told], "errors": [{"reward": 0.1, "state": 0.0}]}
        return {"task": "cartpole", "arm": "paper", "seed": seed, "design": design, "episodes": episodes}

    rows = [row(0, [200] * 199 + [150]), row(1, [200] * 200), row(2, [200] * 99 + [9] + [200] * 99 + [9])]
    lines = {line[0]: line for line in table(rows, "cartpole")}
    assert lines["starts +-0.1, runs with 200 on average (%)"][1:3] == ("83", "50 (0 to 100)")
    assert lines["real steps"][1:3] == ("50 + 70 = 120", "120")
    assert markdown(list(lines.values())).startswith("| what | the paper | preset paper |")


def test_the_paper_study_refuses_a_task_that_is_not_in_the_paper(lab):
    said = lab("paper", "--tasks", "acrobot")
    assert said.code == 1
    assert "unknown task 'acrobot': expected some of pendulum, cartpole" in said.err


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--jobs", "2"), "--jobs: expected --on-ray ADDRESS with more than 1, got 2 without it"),
        (("--on-ray", "127.0.0.1:9"), "expected a Ray cluster at '127.0.0.1:9', got none"),
    ],
)
def test_parallel_runs_of_the_paper_command_require_a_ray_cluster(lab, options, told):
    said = lab("paper", *options)
    assert said.code == 1
    assert told in said.err
    assert len(said.err.strip().splitlines()) == 1


@pytest.mark.e2e
@pytest.mark.slow
@pytest.mark.long
def test_a_quick_paper_study_writes_table_and_pictures_and_is_not_repeated(lab, tmp_path):
    quick = ("paper", "--quick", "--tasks", "cartpole", "--seeds", "1", "--out", str(tmp_path), "--json")
    said = lab(*quick)
    assert said.code == 0, said.err
    table_of = {line[0]: line for line in said.json["tables"]["cartpole"]}
    assert table_of["real steps"][1:] == ["50 + 70 = 120", "12", "6"]  # no hypercube, no column of it
    numbers = (tmp_path / "results.csv").read_text().splitlines()
    assert numbers[0] == "task,arm,seed,what,value"
    assert "cartpole,paper,0,real steps,12.0" in numbers
    assert {p.name for p in tmp_path.glob("*.png")} == {"figure14.png", "figure15.png"}
    assert "| starts +-0.1, trials of 200 (%) |" in (tmp_path / "results.md").read_text()
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert [row["arm"] for row in rows] == ["paper", "printed", "default"]
    servers = {path: path.stat().st_mtime_ns for path in tmp_path.glob("cells/*/server.url")}
    assert len(servers) == 3
    assert lab(*quick).json == said.json
    assert {path: path.stat().st_mtime_ns for path in servers} == servers  # no server was needed
