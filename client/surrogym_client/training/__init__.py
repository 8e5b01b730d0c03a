"""Learning a policy in a surrogate. Importing this room needs no torch."""

from surrogym_client.training.settings import TrainingInterrupted, TrainProgress, TrainResult, TrainSettings

__all__ = ["TrainProgress", "TrainResult", "TrainSettings", "TrainingInterrupted"]
