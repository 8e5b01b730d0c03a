"""What a demo asks for, before it starts anything."""

import pytest

from surrogym.demo.settings import DemoSettings
from surrogym.demo.tasks import TASKS, design_budget
from surrogym_shared.spec import Access


def test_a_demo_uses_the_budget_of_its_task_unless_given():
    assert DemoSettings("acrobot").real_steps == TASKS["acrobot"].budget
    assert DemoSettings("acrobot", budget=70, access="reset").real_steps == 70


@pytest.mark.parametrize("access", ["snapshot", "reset"])
def test_a_demo_without_settable_states_uses_the_default_budget(access: Access):
    settings = DemoSettings("pendulum", access=access)
    spec = settings.spec()
    assert (spec.access, settings.real_steps) == (access, 60)
    assert spec.design.budget == design_budget(60), "rounds take the rest"
    assert settings.judged_by().access == "any", "a policy is judged by the same environment"
