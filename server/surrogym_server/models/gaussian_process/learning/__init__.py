"""Learning of a model from samples: targets, evidence, regions, jumps of the reward."""
