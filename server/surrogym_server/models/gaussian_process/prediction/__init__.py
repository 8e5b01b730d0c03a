"""A fitted model, ready to predict."""
