"""Policies: their files, the cards beside them, their networks, and their export. Importing this package does not
import torch."""

from surrogym_trainer.policies.card import PolicyCard, UnusablePolicy, read_card
from surrogym_trainer.policies.files import load_policy

__all__ = ["PolicyCard", "UnusablePolicy", "load_policy", "read_card"]
