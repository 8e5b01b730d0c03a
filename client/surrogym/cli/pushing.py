"""Store policies on the server at the end of other commands."""

from __future__ import annotations

from pathlib import Path


def push_or_say(
    server: str | None, token: str | None, policy: Path, surrogate: str | None = None, *, quiet: bool = False
) -> int | None:
    """Store a policy and its waiting evaluations on the server, and return its version.

    An unreachable server must not spoil a training or an evaluation. So an error of the server is only printed, with
    the command that stores the policy later, and the result is None.
    """
    from surrogym.cli.options import connect
    from surrogym_client.errors import SurrogymClientError
    from surrogym_shared.terminal import say
    from surrogym_trainer.policies.pushing import push

    try:
        with connect(server, token) as api:
            sent = push(api, policy, surrogate)
    except SurrogymClientError as error:
        say(
            f"the policy was not stored on the server: {error}; to store it later: surrogym policy push {policy}",
            quiet=quiet,
        )
        return None
    if sent.refused:
        say(f"the server did not take the video: {sent.refused}", quiet=quiet)
    say(f"stored on the server as {sent.surrogate}@{sent.policy.version}", quiet=quiet)
    return sent.policy.version
