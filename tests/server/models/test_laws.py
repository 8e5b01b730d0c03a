"""Every family of this package keeps the laws of the port, in every kind of environment."""

import pytest

from support.selected import mixed_cases
from surrogym_server.testing import LAWS_OF_MODELS, model_cases

FAMILIES: dict[str, dict[str, float]] = {
    "gaussian_process": {},
    "ensemble": {"steps": 300},
    "bayesian_last_layer": {"networks": 2, "iterations": 60},
    "selected": {"steps": 50},
}
THROUGH_INDUCING_POINTS = model_cases("sparse_gaussian_process", {"inducing": 40}, 200)  # fewer samples are exact
PROCESS, SPARSE, ENSEMBLE = "gaussian_process", "sparse_gaussian_process", "ensemble"
LAST_LAYER = "bayesian_last_layer"
MIXED = {  # families of angle, speed and reward
    "speed by networks": (PROCESS, ENSEMBLE, PROCESS),
    "reward by networks": (PROCESS, PROCESS, ENSEMBLE),
    "speed by last layers": (PROCESS, LAST_LAYER, PROCESS),
    "processes of two kinds": (PROCESS, SPARSE, SPARSE),
}
OF_CANDIDATES: dict[str, float | str] = {
    "candidates": ", ".join((PROCESS, SPARSE, ENSEMBLE, LAST_LAYER)),
    "steps": 300,
    "networks": 2,
    "iterations": 60,
}
CASES = {f"{family}, {case}": case for family, own in FAMILIES.items() for case in model_cases(family, own)}
CASES |= {f"sparse_gaussian_process, {case}": case for case in THROUGH_INDUCING_POINTS}
CASES |= {f"{name}, {case}": case for name, serving in MIXED.items() for case in mixed_cases(serving, OF_CANDIDATES)}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("law", LAWS_OF_MODELS, ids=lambda law: law.__name__)
def test_a_family_keeps_the_laws(law, name):
    law(CASES[name])
