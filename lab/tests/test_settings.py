"""What an arm may spend, and that it spends it: budgets are equal, and the default can only spend less."""

import pytest

from support.simulators import installed
from surrogym.demo.learning import later_imports
from surrogym.demo.tasks import (
    ROUNDS,
    TASKS,
    DemoTask,
    Outcome,
    Target,
    design_budget,
    queries_a_round,
)
from surrogym_lab.arms import ARMS
from surrogym_lab.settings import StudySettings
from surrogym_lab.tasks import BY_NAME, EVERY_TASK
from surrogym_sampler.original.loading import is_known

KNOWN = [name for name, task in TASKS.items() if is_known(task.environment)]


@pytest.mark.parametrize("budget", [2, 8, 14, 20, 21, 60, 100, 200])
def test_the_closed_loop_training_of_a_study_stays_within_the_real_step_budget(budget):
    spent = design_budget(budget) + ROUNDS * queries_a_round(budget)
    assert budget - ROUNDS < spent <= budget


@pytest.mark.parametrize("task", KNOWN)
def test_study_variants_have_the_same_budget(task):
    for name, arm in ARMS.items():
        settings = StudySettings(task, seed=3, arm=name)
        design = settings.spec().design
        expected = design_budget(TASKS[task].budget) if arm.closed_loop else TASKS[task].budget
        assert (design.budget, design.seed) == (expected, 3)
        assert settings.judged_by().design.preset == "default"


def test_study_variants_without_rounds_train_as_long_as_those_with_rounds():
    steps = {name: StudySettings("swingup", arm=name).virtual_steps for name in ARMS}
    alone = {name for name, arm in ARMS.items() if not arm.closed_loop and not arm.original}
    assert steps == {name: 1_000_000 if name in alone else None for name in ARMS}
    assert {StudySettings("pendulum", arm=name).virtual_steps for name in ARMS} == {None}
    assert StudySettings("swingup", arm="no_loop", steps=9).virtual_steps == 9


def test_study_trainings_are_prolonged_unless_steps_are_given_or_preset_paper():
    prolonged = {name for name in ARMS if StudySettings("acrobot", arm=name).prolong}
    assert prolonged == set(ARMS) - {"paper", "paper_hypercube", "oracle"}
    assert not StudySettings("acrobot", steps=1_750_000).prolong
    assert not StudySettings("pendulum", algorithm="cmaes").prolong, "it trains for a fixed number of steps"


def test_study_variants_have_different_specifications():
    designs = {name: StudySettings("acrobot", arm=name).spec().design for name in ARMS}
    assert designs["variance"].acquisition == "variance"
    assert designs["latin_hypercube"].acquisition == designs["paper_hypercube"].acquisition == "latin_hypercube"
    assert (designs["paper"].preset, designs["paper"].initial) == ("paper", 33)
    assert designs["no_loop"].acquisition is designs["default"].acquisition is None


def test_a_study_variant_is_identified_by_its_own_options():
    assert ARMS["declared_starts"].fields() == {"closed_loop": True, "start_box": 0}
    assert ARMS["no_loop"].fields() == {}
    assert len({str(arm.fields()) for arm in ARMS.values()}) == len(ARMS)


def test_the_paper_variant_learns_its_own_cart_pole_and_is_evaluated_on_gymnasiums():
    settings = StudySettings("cartpole", arm="paper")
    assert settings.spec().time_limit == 200
    assert settings.judged_by().time_limit == 500


def test_a_study_target_is_reached_only_if_all_its_criteria_hold():
    target = Target("all", mean=-160, lowest=-400, success=1.0, also_success=0.98)
    good = Outcome(-150.0, -399.0, 1.0)
    assert target.reached(good, Outcome(-500.0, -900.0, 0.98))
    assert not target.reached(good, Outcome(-500.0, -900.0, 0.97))
    assert not target.reached(good)
    for other in (Outcome(-161.0, -399.0, 1.0), Outcome(-150.0, -401.0, 1.0), Outcome(-150.0, -399.0, 0.99)):
        assert not target.reached(other, Outcome(0.0, 0.0, 1.0))
    assert Target("mean", mean=93).reached(Outcome(93.0, 0.0, None))


def test_success_criteria_of_study_tasks_refer_to_whole_episodes():
    success = {task: StudySettings(task).judged_by().success for task in KNOWN}
    assert success["cartpole"].min_steps == 500
    assert success["invertedpendulum"].min_steps == 1_000
    for task in ("pendulum", "swingup", "swingup-narrow"):
        assert (success[task].hold_steps, abs(success[task].hold[0].value)) == (20, 0.95)


def test_a_demo_imports_torch_early_only_if_its_policy_needs_it():
    assert later_imports(StudySettings(pictures=False)) == ()
    assert later_imports(StudySettings(algorithm="ppo", pictures=False)) == ("stable_baselines3",)


@installed("mujoco")
def test_a_study_of_an_environment_by_name_counts_the_steps_of_describing_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(EVERY_TASK, "crawler", DemoTask("Swimmer-v5", 40, Target("mean 100", mean=100)))
    settings = StudySettings("crawler", seed=2)
    spec, judged = settings.spec(), settings.judged_by()
    assert (spec.design.budget, spec.design.seed, judged.design.seed) == (design_budget(40), 2, 0)
    assert spec.coordinates == judged.coordinates
    assert settings.description_steps >= 400
    assert spec.coordinates != StudySettings("crawler", seed=3).spec().coordinates, "a description for each seed"
    assert StudySettings("pendulum").description_steps == 0


def test_environments_given_by_name_are_not_part_of_the_default_study():
    assert not set(BY_NAME) & set(TASKS)
    assert set(BY_NAME) < set(EVERY_TASK)
