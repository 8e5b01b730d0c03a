"""One environment as the core sees it: definition, terms, actions, features, samples, and the rules of a step."""
