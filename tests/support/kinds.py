"""Environments that differ in what a step computes: limits, walls, angles, ends, rewards and actions."""

from __future__ import annotations

from collections.abc import Callable

from surrogym_sampler.original.classic import acrobot, cartpole, pendulum
from surrogym_sampler.original.swingup import swing_up, swing_up_narrow
from surrogym_shared.spec import DeclaredReward, EnvironmentSpec, Quantity, RewardTerm, Term


def paper(spec: EnvironmentSpec) -> EnvironmentSpec:
    return spec.model_copy(update={"design": spec.design.model_copy(update={"preset": "paper"})})


def paid_in_a_ball(spec: EnvironmentSpec) -> EnvironmentSpec:
    across, up = (Quantity(term=2.0 * term) for term in (Term.sin(theta=1), Term.cos(theta=1) + Term.constant(0.5)))
    term = RewardTerm(shape="ball", weight=3, of=(across, up))
    return spec.model_copy(update={"reward": DeclaredReward(kind="declared", timing="after", terms=(term,))})


ENVIRONMENTS: dict[str, Callable[[], EnvironmentSpec]] = {
    "cart-pole": cartpole,
    "acrobot": acrobot,
    "swing-up": swing_up,
    "narrow swing-up": swing_up_narrow,
    "paper": lambda: paper(pendulum()),
    "paid in a ball": lambda: paid_in_a_ball(pendulum()),
    "learned ending": lambda: cartpole().model_copy(update={"termination": "learned"}),
}
