"""Measure what a policy earns: in real episodes of the original environment, or in imagined ones of the surrogate."""

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
