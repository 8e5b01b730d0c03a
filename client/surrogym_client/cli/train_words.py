"""What ``surrogym train`` says, while it runs and at its end."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from surrogym_client.training import TrainResult


def words_of_result(result: TrainResult) -> str:
    """What a training gave, and what is next."""
    lost = result.lost_episodes
    cut = f"; {lost} episode{'s' * (lost > 1)} cut short, lost with the server's sessions" if lost else ""
    return (
        f"{result.path}: {result.virtual_steps} virtual steps in {result.seconds:.1f} s"
        f"{_imagined(result.imagined_return)}{cut}; next: surrogym evaluate {result.path}"
    )


def words_of(now: dict[str, Any]) -> str:
    """One look at the training, from the fields of ``TrainProgress``."""
    penalty = f", penalty {now['episode_penalty']:.1f} an episode" if now["episode_penalty"] else ""
    index = now.get("visited_confidence")
    known = "" if index is None else f", confidence index {index:.4f} where the policy went"
    return f"{now['steps']} of {now['total_steps']} virtual steps{_imagined(now['imagined_return'])}{penalty}{known}"


def _imagined(value: float | None) -> str:
    return "" if value is None else f", imagined return {value:.1f} (in the surrogate)"
