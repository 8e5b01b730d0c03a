"""Policies that commands send to the server as they end."""

from __future__ import annotations

from pathlib import Path


def push_or_say(
    server: str | None, token: str | None, policy: Path, surrogate: str | None = None, *, quiet: bool = False
) -> int | None:
    """Send a policy with what waits beside it; gives its version, or says why it is not there and how to send it later.

    A server that is away must not cost a training or an evaluation, so nothing is raised.
    """
    from surrogym_client.cli.options import connect
    from surrogym_client.errors import SurrogymClientError
    from surrogym_client.policies.pushing import push
    from surrogym_shared.terminal import say

    try:
        with connect(server, token) as api:
            sent = push(api, policy, surrogate)
    except SurrogymClientError as error:
        say(f"not stored on the server: {error}; to store it later: surrogym policy push {policy}", quiet=quiet)
        return None
    say(f"stored on the server as {sent.surrogate}@{sent.policy.version}", quiet=quiet)
    return sent.policy.version
