"""The learning rate of a policy over its training."""

LEARNING_RATE = 3e-3
LAST_RATE = 0.02  # share of the learning rate that is left at the end


def decaying(remaining: float) -> float:
    """Learning rate of PPO, by the share of the training that remains."""
    return LEARNING_RATE * max(remaining, LAST_RATE)
