"""Options of ``surrogym evaluate`` for controllers that run from the same starts as the policy."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from surrogym.cli.errors import CommandError

if TYPE_CHECKING:
    from collections.abc import Callable

    from surrogym.cli.groups import PolicyReading
    from surrogym_sampler.original.episode import Episode
    from surrogym_shared.spec import EnvironmentSpec
    from surrogym_shared.wire import Controller
    from surrogym_trainer.evaluation.evaluator import EvaluationSettings
    from surrogym_trainer.policies.card import PolicyCard
    from surrogym_trainer.policies.predict import Acting, Predict

Compare = Literal["zero", "random"]


@dataclass(frozen=True)
class Beside:
    """Options for controllers that run from the same starts as the policy, to compare their returns with its return."""

    compare: Annotated[
        Compare | None,
        typer.Option(
            help="Also run the same starts without the policy: with an action of zero, or with random actions. These "
            "real steps count too."
        ),
    ] = None
    reference: Annotated[
        str | None,
        typer.Option(
            help="Also run the same starts with a reference controller: a policy file, or package.module:name of a "
            "function from an observation to an action, or of a class with such a method __call__. Each episode gets "
            "an instance of the class. These real steps count too. The module's code is run."
        ),
    ] = None

    def check(self, settings: EvaluationSettings) -> None:
        """Raise ``CommandError`` if --compare or --reference is given together with --explore, which changes actions
        at random."""
        if settings.explore and (self.compare or self.reference):
            option = "--compare" if self.compare else "--reference"
            raise CommandError(f"expected {option} without --explore, which changes actions; give one of the two")

    def controllers(
        self, policy: Path, card: PolicyCard, reading: PolicyReading, opener: Callable[[], Episode]
    ) -> dict[Controller, Callable[[], Acting]]:
        """Return, by the kind of controller, functions that load the controllers to run: the policy first, then those
        to compare with it.

        Args:
            policy: file of the policy.
            card: card of the policy.
            reading: options for reading policy files.
            opener: opens the original environment.

        Raises:
            PolicyMisfit: the reference controller is a policy that was trained for another environment.
            OriginalError: there is no such reference controller; nothing was run.
        """
        from surrogym_sampler.original.fitting import check_policy

        found: dict[Controller, Callable[[], Acting]] = {"policy": lambda: reading.acting(policy, card)}
        compare = self.compare
        if compare is not None:
            found[compare] = lambda: _baseline(opener, compare)
        if self.reference is not None:
            reference = reference_of(self.reference, reading)
            if (trained_for := spec_of_reference(self.reference)) is not None:
                with closing(opener()) as episode:
                    check_policy(trained_for, episode.spec)
            found["reference"] = lambda: reference
        return found


def spec_of_reference(given: str) -> EnvironmentSpec | None:
    """Return the specification in the card of a reference controller that is a policy file; None if the card has none,
    or if the controller is code."""
    from surrogym_trainer.policies.card import read_card

    return read_card(Path(given)).spec if Path(given).exists() else None


def _baseline(opener: Callable[[], Episode], compare: Compare) -> Predict:
    from surrogym_trainer.evaluation.baselines import baseline

    episode = opener()
    try:
        return baseline(episode.spec, compare)
    except ValueError as error:
        raise CommandError(f"--compare: this controller can't be used here: {error}") from error
    finally:
        episode.close()


def reference_of(given: str, reading: PolicyReading) -> Acting:
    """Load a reference controller: a policy file, or ``package.module:name``.

    Raises:
        CommandError, OriginalError, UnusablePolicy: there is no controller of this name, or it can't be used.
    """
    from surrogym_trainer.evaluation.baselines import load_reference
    from surrogym_trainer.policies.card import read_card

    if Path(given).exists():
        return reading.acting(Path(given), read_card(Path(given)))
    if ":" not in given:
        raise CommandError(f"--reference: expected a policy file that exists, or package.module:name, got {given!r}")
    return load_reference(given)
