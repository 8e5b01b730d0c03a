"""Names of a specification, which people see on terminals and pages."""

import pytest
from pydantic import ValidationError

from surrogym_sampler.original.classic import pendulum
from surrogym_shared.spec import Coordinate, EnvironmentSpec, Uniform


@pytest.mark.parametrize("name", ["x\x1b[31m", "x\x00", "x\n", "\u202ex", ""])
def test_a_coordinate_name_with_control_characters_is_refused(name: str):
    with pytest.raises(ValidationError, match="name"):
        Coordinate(name=name, sampling=Uniform(low=0, high=1))


def test_an_environment_name_with_control_characters_is_refused():
    with pytest.raises(ValidationError, match="environment"):
        EnvironmentSpec.model_validate(pendulum().model_dump() | {"environment": "cart\x1b[2J"})


def test_coordinate_names_may_contain_non_ascii_letters():
    assert Coordinate(name="θ in °", sampling=Uniform(low=0, high=1)).name == "θ in °"
