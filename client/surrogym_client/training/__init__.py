"""Learning a policy in a surrogate. Importing this room needs no torch; a search imports what it works with."""

from surrogym_client.training.settings import TrainingInterrupted, TrainProgress, TrainResult, TrainSettings
from surrogym_client.training.trainer import train

__all__ = ["TrainProgress", "TrainResult", "TrainSettings", "TrainingInterrupted", "train"]
