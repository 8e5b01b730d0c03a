"""Families of dynamics models: each is a learning algorithm, the model that it fits, and the storage of this model."""
