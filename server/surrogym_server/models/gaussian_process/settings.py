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
    """

    kernel: str = "composite"
    reward_jumps: bool = True
    symmetry: str = "auto"

    def __post_init__(self) -> None:
        for name, known in CHOICES.items():
            if (given := getattr(self, name)) not in known:
                raise ValueError(f"expected {name} to be one of {', '.join(known)}, got {given!r}")
        if not isinstance(self.reward_jumps, bool):
            raise ValueError(f"expected reward_jumps to be true or false, got {self.reward_jumps!r}")
