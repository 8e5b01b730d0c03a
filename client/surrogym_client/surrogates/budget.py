"""Check that the budget of real steps is large enough for the rounds of a training."""

from __future__ import annotations

from surrogym_client.errors import SurrogymClientError
from surrogym_client.transport.api import Api


class BudgetTooSmall(SurrogymClientError):
    """The budget has too few real steps for the rounds of a training, and the token may not raise it."""


def words_of_rounds(api: Api, name: str, queries: int, rounds: int) -> str:
    """Describe how many real steps the rounds of a training may cost.

    Args:
        api: the server.
        name: name of the surrogate.
        queries: real steps of each round.
        rounds: number of rounds.

    Raises:
        BudgetTooSmall: the budget has fewer steps left, and the token may not raise it.
    """
    view = api.surrogate(name)
    if view.phase == "ready":
        return f"the design of {name!r} is ready: its rounds take no real steps, unless an audit fails"
    needed = queries * rounds
    left = f"the budget of {name!r} has {view.budget_left} of {view.budget} real steps left"
    if needed <= view.budget_left:
        return f"up to {needed} more real steps ({rounds} rounds of {queries}); {left}"
    budget = view.budget + needed - view.budget_left
    if api.access().role == "admin":
        return (
            f"up to {needed} more real steps ({rounds} rounds of {queries}); {left}, and will be raised to at most "
            f"{budget}"
        )
    raise BudgetTooSmall(
        f"{rounds} rounds of {queries} queries need up to {needed} more real steps, and {left}: lower "
        f"--improve or --rounds, or let an admin raise the budget (surrogym change {name} --budget {budget})"
    )
