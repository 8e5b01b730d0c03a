"""The Surrogym client: remote environments, the sampler, training and evaluation."""
