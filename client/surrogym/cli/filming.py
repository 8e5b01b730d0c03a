"""The video of ``surrogym evaluate --video``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from surrogym_sampler.original.episode import Episode
    from surrogym_shared.spec import EnvironmentSpec
    from surrogym_trainer.evaluation.evaluator import Evaluation, EvaluationSettings
    from surrogym_trainer.policies.card import PolicyCard


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
    """Write a video of the best, median and worst episode beside the policy, and return its path.

    An older video is replaced. If no video can be made, the reason is printed, and the result is None, because a video
    must not spoil an evaluation.
    """
    from surrogym_client.environments.pictures import NotRenderable
    from surrogym_shared.terminal import progress, say
    from surrogym_trainer.evaluation.reporting import words_of
    from surrogym_trainer.evaluation.videos import FORMS, record

    try:
        spec = _spec(env, card, opener)
        with progress("video", quiet=quiet) as update:
            update(None, "drawing the best, the median and the worst episode")
            video = record(spec, env or spec.environment, result, words_of(settings))
    except NotRenderable as error:
        say(f"no video: {error}", quiet=quiet)
        return None
    except Exception as error:  # a user's environment may raise any exception
        say(f"no video: {type(error).__name__}: {error}", quiet=quiet)
        return None
    for form in FORMS:
        policy.with_suffix(f".{form}").unlink(missing_ok=True)
    path = policy.with_suffix(f".{video.form}")
    path.write_bytes(video.content)
    say(f"video written to {path} ({len(video.content) / 1000:.0f} kB)", quiet=quiet)
    return path


def _spec(env: str | None, card: PolicyCard, opener: Callable[[], Episode]) -> EnvironmentSpec:
    """Return the specification of the environment to draw. The environment is opened to get it, unless it is a user's
    own environment, which may be a machine, and the policy's card contains a specification."""
    from surrogym_sampler.original.loading import is_own

    if env is not None and is_own(env) and card.spec is not None:
        return card.spec
    episode = opener()
    try:
        return episode.spec
    finally:
        episode.close()
