"""Evaluation of policies: the returns of real episodes in the original environment, or of imagined ones in the
surrogate."""

from surrogym_trainer.evaluation.evaluator import Evaluation, EvaluationInterrupted, EvaluationSettings, evaluate
from surrogym_trainer.evaluation.imagined import imagined_returns, observation_statistics

__all__ = [
    "Evaluation",
    "EvaluationInterrupted",
    "EvaluationSettings",
    "evaluate",
    "imagined_returns",
    "observation_statistics",
]
