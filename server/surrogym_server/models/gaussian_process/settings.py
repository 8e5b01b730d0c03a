"""Settings of the family of Gaussian processes, which a specification can change."""

from __future__ import annotations

from dataclasses import dataclass

from surrogym_server.models.setting_checks import require_whole

CHOICES = {"kernel": ("composite", "squared_exponential"), "symmetry": ("auto", "none")}
FEWEST, MOST = 10, 2_000  # the setting ``inducing`` must be 0 or between these numbers


@dataclass(frozen=True)
class Settings:
    """Settings of the learner of Gaussian processes: which structures are compared by evidence, and how many inducing
    points are used.

    Attributes:
        kernel: kernel of every process. ``composite`` adds a linear part to the squared exponential, and for the reward
            also a quadratic part.
        reward_jumps: whether the reward may be higher or lower by a constant inside learned regions of states.
        symmetry: ``auto`` also compares functions with mirror symmetry, ``none`` does not.
        rates: whether a transition output may change faster the larger an input is; see ``gp.growth``.
        reward_peaks: whether the reward may be learned by its logarithm, if it is nearly zero almost everywhere.
        drop_inputs: whether an output may ignore inputs that don't matter to it; see ``gp.selection``.
        repeated_parts: whether outputs that are the same function of different inputs may share samples; see
            ``gp.pooling``. Needs ``drop_inputs``.
        inducing: greatest number of inducing points of a process. With more than 150 samples, hyperparameters maximise
            the variational bound of all samples. 0 fits hyperparameters to subsets of the samples.
    """

    kernel: str = "composite"
    reward_jumps: bool = True
    symmetry: str = "auto"
    reward_peaks: bool = True
    rates: bool = True
    drop_inputs: bool = True
    repeated_parts: bool = True
    inducing: int = 0

    def __post_init__(self) -> None:
        for name, choices in CHOICES.items():
            if (value := getattr(self, name)) not in choices:
                raise ValueError(f"expected the setting {name} to be one of {', '.join(choices)}, got {value!r}")
        for name in ("reward_jumps", "reward_peaks", "rates", "drop_inputs", "repeated_parts"):
            if not isinstance(value := getattr(self, name), bool):
                raise ValueError(f"expected the setting {name} to be true or false, got {value!r}")
        if self.inducing != 0 or isinstance(self.inducing, bool):
            require_whole("inducing", self.inducing, FEWEST, MOST)
