"""The constants of Adam, with Stable-Baselines3's values, for the update in NumPy and the compiled one."""

FIRST_DECAY, SECOND_DECAY, EPSILON = 0.9, 0.999, 1e-5
