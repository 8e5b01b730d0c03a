"""One environment as the core represents it: definition, terms, actions, features, samples, and the rules of a step."""
