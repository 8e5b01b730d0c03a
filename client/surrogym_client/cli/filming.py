"""The video of ``surrogym evaluate --video``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from surrogym_client.evaluation.evaluator import Evaluation, EvaluationSettings
    from surrogym_client.original.episodes import Episode
    from surrogym_client.policies.card import PolicyCard


def film(
    policy: Path,
    env: str | None,
    card: PolicyCard,
    opener: Callable[[], Episode],
    result: Evaluation,
    settings: EvaluationSettings,
    *,
    quiet: bool,
) -> Path | None:
    """Write a video of the best, median and worst episode beside the policy, in the place of an older one.

    An environment without a picture must not spoil an evaluation: the terminal then shows the reason, and the result is
    None.
    """
    from surrogym_client.evaluation.reporting import words_of
    from surrogym_client.evaluation.videos import FORMS, record
    from surrogym_client.original.errors import NotRenderable
    from surrogym_shared.terminal import progress, say

    episode = opener()
    spec = episode.spec
    episode.close()
    name = env or (card.spec.environment if card.spec is not None else spec.environment)
    try:
        with progress("video", quiet=quiet) as update:
            update(None, "drawing the best, the median and the worst episode")
            video = record(spec, name, result, words_of(settings))
    except NotRenderable as error:
        say(f"no video: {error}", quiet=quiet)
        return None
    for form in FORMS:
        policy.with_suffix(f".{form}").unlink(missing_ok=True)
    path = policy.with_suffix(f".{video.form}")
    path.write_bytes(video.content)
    say(f"video written to {path} ({len(video.content) / 1000:.0f} kB)", quiet=quiet)
    return path
