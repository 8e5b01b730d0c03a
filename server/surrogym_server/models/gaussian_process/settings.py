"""Settings of the family of Gaussian processes, as a specification may give them."""

from __future__ import annotations

from dataclasses import dataclass

CHOICES = {"kernel": ("composite", "squared_exponential"), "symmetry": ("auto", "none")}


@dataclass(frozen=True)
class Settings:
    """What is compared by evidence.

    Attributes:
        kernel: of every process; ``composite`` adds a linear part, and for the reward a quadratic one.
        reward_jumps: whether the reward may jump where a learned region begins.
        symmetry: ``auto`` compares feature maps that are their own mirror image with the others, ``none`` does not.
        reward_peaks: whether the reward may be learned by its logarithm, where it is next to nothing nearly everywhere.
    """

    kernel: str = "composite"
    reward_jumps: bool = True
    symmetry: str = "auto"
    reward_peaks: bool = True

    def __post_init__(self) -> None:
        for name, known in CHOICES.items():
            if (given := getattr(self, name)) not in known:
                raise ValueError(f"expected {name} to be one of {', '.join(known)}, got {given!r}")
        for name in ("reward_jumps", "reward_peaks"):
            if not isinstance(given := getattr(self, name), bool):
                raise ValueError(f"expected {name} to be true or false, got {given!r}")
