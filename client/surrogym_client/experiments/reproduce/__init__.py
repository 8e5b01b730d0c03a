"""Evidence: what the documentation claims, made again from real runs."""
