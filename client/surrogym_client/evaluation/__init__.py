"""What a policy earns: in the original environment by real episodes, in the surrogate by imagined ones."""

from surrogym_client.evaluation.evaluator import Evaluation, EvaluationInterrupted, EvaluationSettings, evaluate
from surrogym_client.evaluation.imagined import imagined_returns, observation_statistics

__all__ = [
    "Evaluation",
    "EvaluationInterrupted",
    "EvaluationSettings",
    "evaluate",
    "imagined_returns",
    "observation_statistics",
]
