"""Largest sizes of a policy's network and of a rollout that a server accepts."""

MAX_LAYERS = 8  # largest number of layers of a policy network
MAX_UNITS = 1_024  # largest number of units in one layer of a policy network
MAX_PARAMETERS = 262_144  # largest number of weights and biases of a policy network
MAX_ROLLOUT = 100_000  # largest number of steps of a rollout in one request
MAX_LANE_STEPS = 1_000_000  # largest number of steps in one request, summed over lanes
MAX_ACTIVATIONS = 2**24  # largest product of lanes and units of the widest layer: 128 MiB of activations
