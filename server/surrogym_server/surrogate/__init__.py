"""From samples to a model of one environment: terms, coordinates, features, targets, reward, termination."""
