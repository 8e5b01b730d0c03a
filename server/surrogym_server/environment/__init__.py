"""Representation of one environment in the core: definition, terms, actions, features, samples, and rules of a step."""
