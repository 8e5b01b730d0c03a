"""Every family of this package keeps the laws of the port, in every kind of environment."""

import pytest

from surrogym_server.testing import LAWS_OF_MODELS, model_cases

FAMILIES: dict[str, dict[str, float]] = {
    "gaussian_process": {},
    "ensemble": {"steps": 300},
}
THROUGH_INDUCING_POINTS = model_cases("gaussian_process", {"inducing": 40}, 200)  # fewer samples are exact
CASES = {f"{family}, {case}": case for family, own in FAMILIES.items() for case in model_cases(family, own)}
CASES |= {f"through inducing points, {case}": case for case in THROUGH_INDUCING_POINTS}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("law", LAWS_OF_MODELS, ids=lambda law: law.__name__)
def test_every_built_in_model_family_passes_the_model_interface_tests(law, name):
    law(CASES[name])
