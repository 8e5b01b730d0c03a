"""The card of a trained policy: for what, with which settings and with which results it was trained."""

from __future__ import annotations

from collections.abc import Sequence

from surrogym_client.runtime.versions import versions
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import CurvePoint, SurrogateView
from surrogym_trainer.policies.card import NotedAddress, PolicyCard
from surrogym_trainer.policies.pushing import thinned
from surrogym_trainer.training.handover import Handover
from surrogym_trainer.training.settings import TrainResult, noise_of


def card_of(
    result: TrainResult,
    handover: Handover | None = None,
    *,
    surrogate: str,
    spec: EnvironmentSpec,
    url: str,
    seed: int,
    curve: Sequence[CurvePoint],
) -> PolicyCard:
    """Return the card of a policy.

    Args:
        result: result of the training.
        handover: promise and audit; None if the training was interrupted before.
        surrogate: name of the surrogate.
        spec: specification of the surrogate.
        url: address of its server.
        seed: seed of the training.
        curve: points of the training's curve, of which the card keeps some.
    """
    return PolicyCard(
        algorithm=result.algorithm,
        surrogate=surrogate,
        server=NotedAddress(url),
        spec=spec,
        seed=seed,
        virtual_steps=result.virtual_steps,
        seconds=result.seconds,
        imagined_return=result.imagined_return,
        visited_confidence=result.visited_confidence,
        networks=result.networks,
        curve=thinned(curve),
        untrained=result.untrained,
        **({} if handover is None else vars(handover)),
        settings=result.settings,
        versions=versions(),
    )


def session_of(card: PolicyCard, view: SurrogateView) -> dict[str, object]:
    """Return the options of the session in which the policy was judged, from the policy's card. The
    options for noise that the design has confirmed are added, unless the card has them."""
    judged = card.settings.get("judge") or card.settings.get("session") or {}
    noise: dict[str, object] = noise_of(view)
    return {**noise, **judged} if isinstance(judged, dict) else noise
