"""Test functions for authors of a model family. Each checks one law of the interface, and raises ``AssertionError`` if
it is broken.

Examples:
    >>> import pytest
    >>> from surrogym_server.testing import LAWS_OF_MODELS, model_cases
    >>> @pytest.mark.parametrize("case", model_cases("my_family"), ids=str)
    ... @pytest.mark.parametrize("law", LAWS_OF_MODELS)
    ... def test_laws(law, case):
    ...     law(case)
"""

from surrogym_server.testing.ability_laws import LAWS_OF_ABILITIES
from surrogym_server.testing.cases import ModelCase, model_cases
from surrogym_server.testing.model_laws import LAWS_OF_MODELS as _BASIC

LAWS_OF_MODELS = (*_BASIC, *LAWS_OF_ABILITIES)

__all__ = ["LAWS_OF_MODELS", "ModelCase", "model_cases"]
