"""A name from a server opens no file of a person's; the refusal says which option does."""

from __future__ import annotations

import pytest

from support.rail import SPEC
from surrogym.cli.commands.sample import environment_of
from surrogym.cli.errors import CommandError


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("pcgym:tank.json", "expected --env pcgym:tank.json"),
        ("fmu:a plant.fmu", "expected --env 'fmu:a plant.fmu'"),
        ("rail:Rail", "expected --env rail:Rail"),
        ("exec:./plant --port 7", "--env fmu:PLANT.fmu, --env mujoco:FILE.xml, or --exec COMMAND"),
        ("a rail", "--env pcgym:FILE.json, --env fmu:PLANT.fmu, --env mujoco:FILE.xml, or --exec COMMAND"),
    ],
)
def test_the_refusal_to_open_a_surrogates_environment_names_the_option_that_allows_it(name: str, expected: str) -> None:
    """For a file of pc-gym it named every option but the one that is needed."""
    with pytest.raises(CommandError) as refused:
        environment_of(None, None, SPEC.model_copy(update={"environment": name}))
    assert str(refused.value).endswith(expected)
