"""What a policy and its training are by default, whichever library learns it. Importing this needs no torch."""

HIDDEN = 32  # units of the one layer of the paper's actor
WIDER = (64, 64)  # in place of the paper's, which lies 20 below it on Pendulum
CRITIC = (64, 64)
EXPLORATION = 0.5  # first deviation of a continuous action, as a share of half its range
LANES = 128  # of a session that an on-policy algorithm learns in
LEARNING_RATE = 3e-3
LAST_RATE = 0.02  # share of the learning rate that is left at the end
ATTEMPT_SEED = 1_000_003  # between the seeds of one training's networks


def decaying(remaining: float) -> float:
    """Learning rate of PPO, by the share of the training that remains."""
    return LEARNING_RATE * max(remaining, LAST_RATE)
