"""Priors: what is known of a plant before its first real step, as a simulator whose parameters real steps correct."""
