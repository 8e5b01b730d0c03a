"""``surrogym evaluate --learn`` and ``--learn-all``: no real step is taken for nothing, and none is lost."""

from __future__ import annotations

import pytest

from surrogym_client.cli.disagreement import Differences
from surrogym_client.cli.errors import CommandError
from surrogym_client.evaluation.evaluator import EvaluationSettings


def test_a_wait_for_no_model_is_refused():
    """It was ignored, and a person took the model of before for the one that had learned."""
    with pytest.raises(CommandError, match="expected --wait with --learn or --learn-all, got neither"):
        Differences(wait=5.0).check(EvaluationSettings())
    Differences(wait=5.0, learn_all=True).check(EvaluationSettings())
    Differences(wait=5.0, learn=3).check(EvaluationSettings())
