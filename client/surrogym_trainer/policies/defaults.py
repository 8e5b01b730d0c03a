"""Defaults of policies and their training, for all libraries. Importing this needs no torch."""

HIDDEN = 32  # units of the one layer of the paper's actor
WIDER = (64, 64)  # replaces the paper's, whose return on Pendulum is lower by 20
CRITIC = (64, 64)
EXPLORATION = 0.5  # initial standard deviation of a continuous action, as a share of half its range
LANES = 128  # lanes of a session for an on-policy algorithm
LEARNING_RATE = 3e-3
LAST_RATE = 0.02  # final learning rate, as a share of the initial one


def decaying(remaining: float) -> float:
    """Learning rate of PPO, given the share of the training that remains."""
    return LEARNING_RATE * max(remaining, LAST_RATE)
