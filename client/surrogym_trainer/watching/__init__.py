"""A stream of real steps compared with a model, to find out that the plant has changed."""
