"""Whether a budget of real steps holds what somebody is about to ask for."""

from __future__ import annotations

from surrogym_client.errors import SurrogymClientError
from surrogym_client.transport.api import Api


class BudgetTooSmall(SurrogymClientError):
    """The budget does not hold the rounds, and the token may not raise it."""


def words_of_rounds(api: Api, name: str, queries: int, rounds: int) -> str:
    """What rounds of real queries may cost a surrogate, before the first is asked for.

    Raises:
        BudgetTooSmall: more than its budget has left, with a token that may not raise it.
    """
    view = api.surrogate(name)
    if view.phase == "ready":
        return f"the design of {name!r} is ready: no more real steps are asked for"
    needed = queries * rounds
    left = f"the budget of {name!r} has {view.budget_left} of {view.budget} real steps left"
    if needed <= view.budget_left:
        return f"up to {needed} more real steps ({rounds} rounds of {queries}); {left}"
    budget = view.budget + needed - view.budget_left
    if api.access().role == "admin":
        return f"up to {needed} more real steps ({rounds} rounds of {queries}); {left}, and is raised up to {budget}"
    raise BudgetTooSmall(
        f"{rounds} rounds of {queries} queries need up to {needed} more real steps, and {left}: ask for fewer by "
        f"--improve and --rounds, or have a token of role admin raise it (surrogym change {name} --budget {budget})"
    )
