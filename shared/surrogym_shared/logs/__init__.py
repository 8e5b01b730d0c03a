"""Logs of real steps: find the roles of their columns, check their rows, and draft a specification from them."""
