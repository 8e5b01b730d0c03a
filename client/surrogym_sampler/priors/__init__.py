"""Priors: knowledge about a plant before its first real step, in the form of a simulator whose parameters are fitted to
real steps."""
