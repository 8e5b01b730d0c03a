"""Logs of real steps: what their columns are, which rows can be used, and a specification drafted from them."""
