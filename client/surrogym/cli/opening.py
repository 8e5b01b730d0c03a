"""Which environment a policy is evaluated in, and how it is opened."""

from __future__ import annotations

from typing import TYPE_CHECKING

from surrogym.cli.errors import CommandError
from surrogym_shared.terminal import say

if TYPE_CHECKING:
    from collections.abc import Callable

    from surrogym_sampler.original.episode import Episode
    from surrogym_shared.spec import EnvironmentSpec
    from surrogym_trainer.policies.card import PolicyCard


def opener_for_policy(
    env: str | None, given: EnvironmentSpec | None, card: PolicyCard, fallback: str | None = None, *, quiet: bool
) -> Callable[[], Episode]:
    """Return a function that opens an episode for a policy, after a check of the specification.

    Args:
        env: name of the original environment; None takes the one that the policy was trained for.
        given: specification of the environment from --spec; None takes the environment's own specification.
        card: card of the policy.
        fallback: program of the fallback that the specification's limits name, as NAME=package.module:function.
        quiet: whether remarks are hidden.

    Raises:
        PolicyMisfit: the policy was trained for another specification than ``given``.
        UnknownEnvironment: there is no such environment. The message also names the environment of the policy.
    """
    from surrogym_sampler.original.errors import UnknownEnvironment
    from surrogym_sampler.original.fitting import check_policy, meant_in_words

    noted = card.spec
    if given is not None and noted is not None:
        check_policy(noted, given)
    try:
        return opener_of(env, given, card, fallback, quiet=quiet)
    except UnknownEnvironment as error:
        if noted is None or env is None or env == noted.environment:
            raise
        raise UnknownEnvironment(f"the policy is for {meant_in_words(noted)}; {error}") from error


def opener_of(
    env: str | None, given: EnvironmentSpec | None, card: PolicyCard, fallback: str | None = None, *, quiet: bool
) -> Callable[[], Episode]:
    """Return a function that opens an episode. An environment that only a policy's card names is opened only if its
    name runs no file of the user's, because the name of a module would run unknown code.
    """
    from surrogym_sampler.original.episodes import open_episode
    from surrogym_sampler.original.loading import fits, is_known, is_own, make

    noted = card.spec
    name = env or (noted.environment if noted is not None else None)
    if name is None or (env is None and not is_known(name)):
        raise CommandError(f"expected --env with the original environment, got none (the policy's card names: {name})")
    if is_own(name):
        bins = _bins(noted) if given is None else None
        return lambda: open_episode(name, given, lambda: make(name, spec=given, bins=bins), fallback)
    if given is None and noted is not None and fits(noted.environment, name):
        given = _limited(noted, name, quiet=quiet)
    spec = given or make(name).spec()
    return lambda: open_episode(name, spec, lambda: make(name, spec=spec), fallback)


def _limited(noted: EnvironmentSpec, name: str, *, quiet: bool) -> EnvironmentSpec:
    """Return the card's specification with a time limit no longer than the environment's own. A longer limit would cost
    real steps that the user did not request."""
    from surrogym_sampler.original.loading import own_time_limit

    own = own_time_limit(name)
    if noted.time_limit is not None and noted.time_limit <= own:
        return noted
    asked = "none" if noted.time_limit is None else f"{noted.time_limit} steps"
    say(
        f"the policy's card has a time limit of {asked}, that of {noted.environment} is {own}: episodes end after "
        f"{own} steps; --spec FILE chooses another limit",
        quiet=quiet,
    )
    return noted.model_copy(update={"time_limit": own})


def _bins(spec: EnvironmentSpec | None) -> int | None:
    """Return the number of discrete values among which a policy chooses each continuous action; None if its continuous
    actions are not discretised."""
    from surrogym_shared.spec import BoxAction

    action = None if spec is None else spec.action
    return action.bins[0] if isinstance(action, BoxAction) and action.bins else None
