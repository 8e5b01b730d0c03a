"""Types and functions for one environment: its definition, terms, actions, features, samples, and rules of a step."""
