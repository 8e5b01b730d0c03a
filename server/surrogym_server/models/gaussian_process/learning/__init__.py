"""From samples to a model: targets, evidence, regions, jumps of the reward."""
