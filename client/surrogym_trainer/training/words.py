"""Text that ``surrogym train`` prints while it runs and at its end."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from surrogym_trainer.policies.evidence import RangeLeft
    from surrogym_trainer.training.handover import Handover
    from surrogym_trainer.training.settings import TrainResult


def words_of_result(
    result: TrainResult,
    handover: Handover | None = None,
    *,
    asked: int | None = None,
    closed_loop: bool = False,
    fits_planner: bool = False,
    server: str | None = None,
    env_option: str = "",
) -> str:
    """Return a text about the result of a training, with the next command.

    Args:
        result: result of the training.
        handover: the promise and whether it is trusted.
        asked: number of virtual steps that ``--steps`` gave; None without it.
        closed_loop: whether ``--improve`` was given.
        fits_planner: whether a planner could act in this environment.
        server: address that the next command needs; None if it needs none.
        env_option: option of the next command that names the environment, with a space before it.
    """
    options = env_option + ("" if server is None else f" --server {shlex.quote(server)}")
    path, lost = shlex.quote(str(result.path)), result.lost_episodes
    cut = f"; {lost} episode{'s' * (lost > 1)} cut short, because the server lost its sessions" if lost else ""
    rounds = _loop(result.visited_confidence) if closed_loop or result.visited_confidence else ""
    taken = f"{result.virtual_steps} virtual steps{_of_asked(result, asked)}"
    return (
        f"{result.path}: {taken if result.virtual_steps else 'made without training'} in {result.seconds:.1f} s"
        f"{_imagined(result.imagined_return)}{cut}{rounds}"
        f"{_given_up(result.networks - 1, fits_planner)}{_gaining(result)}; next: surrogym evaluate {path}{options}"
        f"{'' if handover is None else chr(10) + words_of_handover(handover)}"
    )


def _of_asked(result: TrainResult, asked: int | None) -> str:
    """Return a sentence about why fewer virtual steps than requested were taken, if the reason is that the rest was
    less than a rollout; else an empty text."""
    rollout = result.settings.get("n_steps", 0) * (result.settings.get("num_envs") or 0)
    if asked is None or not 0 < asked - result.virtual_steps < rollout:
        return ""
    return f" ({asked} asked for; they are taken in rollouts of {rollout})"


def words_of_handover(handover: Handover) -> str:
    """Return a line about the promise of a policy, and whether it is trusted. If the policy leaves a sampling range, a
    line before says where."""
    promise, trusted = handover.promise, "trusted" if handover.trusted else "not trusted"
    if promise is None:
        return f"no promise, {trusted}: {handover.reason}"
    left = None if handover.audit is None else handover.audit.range_left
    return (
        f"{'' if left is None else words_of_range(left) + chr(10)}"
        f"promise{', after learning the audit' if handover.audit else ''}: mean return {promise.median:.4g}, "
        f"between {promise.low:.4g} and {promise.high:.4g} with 90 % chance; "
        f"{'' if promise.fallback is None else promise.fallback.words() + '; '}"
        f"{trusted}: {handover.reason}"
    )


def words_of_no_sampler(result: TrainResult, handover: Handover | None, sample: str) -> str:
    """Return a line about how to audit a policy that was not audited because no sampler was connected; empty for other
    policies. ``sample`` is the command that starts a sampler."""
    from surrogym_trainer.training.handover import NO_SAMPLER

    if handover is None or not handover.reason.endswith(NO_SAMPLER):
        return ""
    return f"\nto audit it: start {sample} in another terminal, then surrogym audit {shlex.quote(str(result.path))}"


def words_of_range(left: RangeLeft) -> str:
    """Return a sentence about the sampling range that a policy leaves, and what to do."""
    beyond, way = ("above", "up") if left.side == "upper" else ("below", "down")
    return (
        f"{100 * left.share:.0f} % of the policy's states have {left.coordinate} {beyond} {left.end:.4g}, the end of "
        "its sampling range, where no real step was requested; to learn there: register under a new name with a range "
        f"{way} to {left.farthest:.3g}"
    )


def words_of_interruption(result: TrainResult, asked: str) -> str:
    """Return a text about the policy that was saved at Ctrl-C, and about how to continue its training. ``asked`` holds
    the arguments of the command: the surrogate and its options."""
    if not result.virtual_steps:  # nothing was trained, so nothing can be continued
        return (
            f"interrupted; the policy is in {result.path}, not audited; to make it again: surrogym train {asked} --out "
            f"{result.path}"
        )
    return (
        f"interrupted after {result.virtual_steps} virtual steps; the policy so far is in {result.path}; to continue: "
        f"surrogym train {asked} --start-from {result.path} --out {result.path}"
    )


def words_of(now: dict[str, Any]) -> str:
    """Return a line about the state of a training, from the fields of ``TrainProgress``."""
    penalty = f", penalty {now['episode_penalty']:.1f} an episode" if now["episode_penalty"] else ""
    steps = f"{now['steps']} of about {now['total_steps']} virtual steps" if now["total_steps"] else ""
    doing = ": ".join(part for part in (now.get("stage"), steps) if part)
    return f"{doing}{_imagined(now['imagined_return'])}{penalty}{_known(now.get('visited_confidence'))}"


def _given_up(networks: int, fits_planner: bool) -> str:
    if not networks:
        return ""
    way = " (--algorithm planner plans with the model instead)" if fits_planner else ""
    return f"; {networks} network{'s' * (networks > 1)} replaced because of slow learning{way}"


def _gaining(result: TrainResult) -> str:
    return f"; it still improved at the end, and --start-from {result.path} continues it" if result.gaining else ""


def _loop(rounds: Sequence[float | None]) -> str:
    """Return a text about the rounds of the closed loop, from the confidence index of each round, which may be unknown
    (None)."""
    if not rounds:
        return "; the design was ready, so no round was needed"
    return f"; {len(rounds)} round{'s' * (len(rounds) > 1)}{_known(rounds[-1])}"


def _known(index: float | None) -> str:
    return "" if index is None else f", confidence index {index:.4f} where the policy went"


def _imagined(value: float | None) -> str:
    return "" if value is None else f", imagined return {value:.4g} (in the surrogate)"
