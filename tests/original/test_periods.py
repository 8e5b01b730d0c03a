"""A declared sampling period is checked against the one that an environment tells."""

from __future__ import annotations

import sys
from pathlib import Path
from textwrap import dedent
from types import SimpleNamespace

import gymnasium
import pytest

from surrogym_sampler import original
from surrogym_sampler.original.classic import TASKS
from surrogym_sampler.original.describing import describe
from surrogym_sampler.original.errors import PolicyMisfit, UnknownEnvironment
from surrogym_sampler.original.fitting import check_policy
from surrogym_sampler.original.mujoco_tasks import SPECIFICATIONS
from surrogym_sampler.original.periods import period_of
from surrogym_sampler.queries.query_limits import check_environment

SPEC = original.make("Pendulum-v1").spec()  # its environment has the attribute dt, 0.05 s


@pytest.mark.parametrize(
    ("told", "period"),
    [
        ({"dt": 0.02}, 0.02),
        ({"sampling_period": 0.1, "dt": 0.001}, 0.1),
        ({"metadata": {"dt": 0.5}}, 0.5),
        ({"metadata": {"dt": True}, "dt": lambda: 1}, None),
        ({"dt": 0.0}, None),
        ({}, None),
    ],
)
def test_the_sampling_period_is_read_from_an_attribute_or_the_metadata(told: dict, period: float | None) -> None:
    assert period_of(SimpleNamespace(**told)) == period


def declared(period: float | None):
    return SPEC.model_copy(update={"sampling_period": period})


@pytest.mark.parametrize("period", [None, 0.05, 0.05 * (1 + 1e-9)])
def test_a_specification_with_the_environments_period_or_none_is_accepted(period: float | None) -> None:
    original.make("Pendulum-v1", spec=declared(period)).close()


def test_a_specification_with_another_sampling_period_is_refused_with_both_values() -> None:
    with pytest.raises(UnknownEnvironment, match=r"every 0\.1 s.* got 0\.05 s"):
        original.make("Pendulum-v1", spec=declared(0.1))


def test_specifications_with_different_sampling_periods_do_not_fit() -> None:
    with pytest.raises(PolicyMisfit, match=r"0\.05 s.* got 0\.1 s"):
        check_policy(declared(0.05), declared(0.1))
    with pytest.raises(UnknownEnvironment, match=r"0\.05 s.* got 0\.1 s"):
        check_environment("rig", declared(0.05), declared(0.1))
    check_policy(declared(0.05), declared(None))


def test_the_sampling_period_of_a_user_defined_environment_class_is_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = """
        from surrogym_sampler import original

        class Fast:
            dt = 0.0025

            def spec(self):
                return original.make("Pendulum-v1").spec().model_copy(update={"sampling_period": 0.005})

            def step_from(self, coordinates, action): ...

            def close(self): ...
    """
    (tmp_path / "fast_plant.py").write_text(dedent(code), encoding="utf-8")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    with pytest.raises(UnknownEnvironment, match=r"fast_plant:Fast .*0\.005 s.* got 0\.0025 s"):
        original.make("fast_plant:Fast")


def test_the_function_describe_declares_the_sampling_period_of_the_environment() -> None:
    assert describe("Pendulum-v1", 40).spec.sampling_period == 0.05


@pytest.mark.parametrize("name", [*TASKS, *SPECIFICATIONS])
def test_built_in_specifications_declare_the_environments_sampling_period(name: str) -> None:
    environment = gymnasium.make(name).unwrapped
    own = period_of(environment) or getattr(environment, "tau", None)  # CartPole calls it tau
    assert original.make(name).spec().sampling_period == own
    assert (own is None) == name.startswith("MountainCar")
