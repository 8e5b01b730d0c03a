"""Constants of Adam, as Stable-Baselines3 sets them; the update in NumPy and the compiled one share them."""

FIRST_DECAY, SECOND_DECAY, EPSILON = 0.9, 0.999, 1e-5
