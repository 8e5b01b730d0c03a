"""Families of models are chosen by name; what is unknown or set wrong is refused in words."""

import pytest

from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.errors import InvalidSpec
from surrogym_server.models.gaussian_process import GaussianProcesses
from surrogym_server.models.registry import MODELS, learner_of
from surrogym_server.plugins import Choice
from surrogym_shared.spec import Design, ModelChoice


def learner(**design: object) -> object:
    spec = pendulum().model_copy(update={"design": Design.model_validate(design)})
    return learner_of(definition_from_spec(spec).learning.model)


def test_the_default_model_is_a_gaussian_process_with_the_settings_of_the_preset():
    assert learner() == GaussianProcesses("composite", True, "auto")
    assert learner(symmetry="none") == GaussianProcesses("composite", True, "none")
    assert learner(preset="paper", symmetry="none") == GaussianProcesses(
        "squared_exponential", False, "none", False, False, False, False
    )


def test_model_settings_of_the_specification_override_those_of_the_preset():
    chosen = ModelChoice(name="gaussian_process", settings={"reward_jumps": False})
    assert learner(model=chosen) == GaussianProcesses("composite", False, "auto")
    assert learner(model="gaussian_process") == learner()


@pytest.mark.parametrize(
    ("choice", "said"),
    [
        (Choice("nobody"), "model: expected one of gaussian_process.*, got 'nobody'"),
        (Choice("gaussian_process", (("depth", 3.0),)), "expected a setting out of kernel, reward_jumps, symmetry"),
        (Choice("gaussian_process", (("kernel", "cubic"),)), "kernel to be one of composite, squared_exponential"),
        (Choice("gaussian_process", (("reward_jumps", 1.0),)), "reward_jumps to be true or false, got 1.0"),
        (Choice("gaussian_process", (("kernel", 1.0),)), "expected kernel to be a text, got 1.0"),
        (Choice("ensemble", (("members", "many"),)), "ensemble: expected members to be a whole number, got 'many'"),
        (Choice("ensemble", (("members", True),)), "ensemble: expected members to be a whole number, got True"),
    ],
)
def test_unknown_model_families_and_invalid_settings_are_refused(choice, said):
    with pytest.raises(InvalidSpec, match=said):
        learner_of(choice)


def test_the_gaussian_process_is_first_in_the_list_of_model_families():
    assert MODELS.names[0] == "gaussian_process"


def test_the_error_for_a_removed_model_family_names_its_replacement():
    assert str(MODELS.lack(Choice("selected"))).startswith("the model family 'selected', which was removed: name")
