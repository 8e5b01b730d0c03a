"""Default settings of policies and their training, for all libraries. Importing this module does not import torch."""

HIDDEN = 32  # units of the single layer of the paper's actor
# units of the layers of the default actor; on Pendulum, the paper's actor has a return that is lower by 20
WIDER = (64, 64)
CRITIC = (64, 64)
EXPLORATION = 0.5  # initial standard deviation of a continuous action, as a share of half its range
LANES = 128  # number of environments in a session of an on-policy algorithm
LEARNING_RATE = 3e-3
LAST_RATE = 0.02  # final learning rate, as a share of the initial one


def decaying(remaining: float) -> float:
    """Return PPO's learning rate, given the share of the training that remains."""
    return LEARNING_RATE * max(remaining, LAST_RATE)
