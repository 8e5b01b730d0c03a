"""Training of policies in a surrogate. Importing this package does not import torch; each search imports its own
libraries."""

from surrogym_trainer.training.settings import TrainingInterrupted, TrainProgress, TrainResult, TrainSettings
from surrogym_trainer.training.trainer import train

__all__ = ["TrainProgress", "TrainResult", "TrainSettings", "TrainingInterrupted", "train"]
