"""Text and JSON about where real steps and the model disagree."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

from surrogym.cli.errors import CommandError, sentence
from surrogym.cli.learning import learning_of
from surrogym.cli.options import await_model, connect
from surrogym_shared.terminal import say

if TYPE_CHECKING:
    from surrogym.cli.learning import Learning, Steps
    from surrogym_client.transport.api import Api
    from surrogym_shared.spec import EnvironmentSpec
    from surrogym_shared.wire import SurrogateView
    from surrogym_trainer.evaluation.comparing import Disagreement, Disagreements, Effect
    from surrogym_trainer.evaluation.evaluator import Evaluation, EvaluationSettings
    from surrogym_trainer.evaluation.systematic import Systematic
    from surrogym_trainer.policies.card import PolicyCard
    from surrogym_trainer.policies.evidence import Promise
    from surrogym_trainer.policies.predict import Predict


@dataclass(frozen=True)
class Differences:
    """Options for comparing the real steps of an evaluation with the model."""

    where: Annotated[
        bool,
        typer.Option(
            "--where",
            help="Show the states at which real steps differ from the model. [default: on if the mean return is "
            "outside the promise]",
        ),
    ] = False
    learn: Annotated[
        int,
        typer.Option(
            min=0,
            help="Maximum number of steps to add to the surrogate's samples: those that differ most from the model. "
            "They were taken already, so they cost no further real step and none of the budget.",
        ),
    ] = 0
    learn_all: Annotated[
        bool,
        typer.Option(
            "--learn-all",
            help="Add every step of the episodes to the surrogate's samples, also those that the model predicts. They "
            "cost no further real step and none of the budget.",
        ),
    ] = False
    wait: Annotated[
        float,
        typer.Option(
            min=0, help="Seconds to wait for the model that learns from these steps, with --learn or --learn-all."
        ),
    ] = 0.0

    @property
    def learns(self) -> bool:
        return self.learn > 0 or self.learn_all

    def check(self, settings: EvaluationSettings) -> None:
        """Check that the options don't contradict each other, and that no model learns from a changed environment.

        Raises:
            CommandError: ``--learn`` or ``--learn-all`` was given together with ``--perturb``, or with each other, or
                ``--wait`` without either.
        """
        if self.learn and self.learn_all:
            raise CommandError("expected --learn or --learn-all, got both; give one of the two")
        if self.wait and not self.learns:
            raise CommandError(
                "expected --wait together with --learn or --learn-all, got --wait alone: add one of the two, or leave "
                "--wait out"
            )
        if self.learns and settings.perturb:
            option = "--learn-all" if self.learn_all else "--learn"
            raise CommandError(
                f"expected {option} with the environment as it is, got --perturb, which changes it; give one of the two"
            )

    def learning(self, surrogate: str | None, server: str | None, token: str | None, *, quiet: bool) -> Learning | None:
        """Return the surrogate that will learn from the real steps, after a check on the server; None without --learn
        and --learn-all. Raises the errors of ``learning_of``."""
        if not self.learns:
            return None
        return learning_of("--learn-all" if self.learn_all else "--learn", surrogate, server, token, quiet=quiet)

    def between(
        self,
        surrogate: str | None,
        server: str | None,
        token: str | None,
        result: Evaluation,
        settings: EvaluationSettings,
        promise: Promise | None,
        steps: Steps | None,
        imagining: Imagining,
        *,
        quiet: bool,
    ) -> Differing | None:
        """Compare the real steps of an evaluation with a surrogate's model, and send steps from which it learns.

        With ``--learn-all`` all steps are sent, even if there is no model yet. Returns None if no option requests a
        comparison and the mean return lies in the promised interval, or if the steps can't be compared and none was
        sent.

        Args:
            surrogate: name of the surrogate; None: there is nothing to compare with.
            server: address of the server; None takes the default.
            token: bearer token for the server.
            result: the episodes.
            settings: settings of the evaluation.
            promise: the policy's promised return; None if these episodes can't test it.
            steps: steps to send; None to send none.
            imagining: imagines episodes of the policy, to find effects of errors on its return.
            quiet: whether remarks are hidden.
        """
        from surrogym_client.errors import SurrogymClientError
        from surrogym_trainer.evaluation.comparing import samples_of

        if surrogate is None or not (self.where or self.learns or left(promise, result)):
            return None
        found, without = None, f"{surrogate!r} has no model yet"
        try:
            with connect(server, token) as api:
                if steps is not None and self.learn_all:
                    steps.send(api)
                found = _compare(api, surrogate, result, settings.first_seed, imagining)
                if found is not None and missed(promise, result):
                    found = replace(found, broken=True)
                if steps is not None and self.learn and found is not None:
                    steps.choose(samples_of(found.found, self.learn))
                    steps.send(api)
        except SurrogymClientError as error:
            without = str(error)
            if steps is not None and steps.waiting:
                steps.fault = sentence(error) or without
            elif steps is None:
                say(f"not compared with the model of {surrogate!r}: {error}", quiet=quiet)
        if steps is None or steps.waiting:
            return found
        if steps.new and self.wait:
            _await_model(server, token, surrogate, self.wait, quiet=quiet)
        found = found or _not_compared(settings.first_seed, without)
        return replace(found, learned=steps.new, all_steps=self.learn_all)


def left(promise: Promise | None, result: Evaluation) -> bool:
    """Whether the mean return of an evaluation lies outside the promised interval; False without a promise."""
    return promise is not None and not promise.low <= result.returns.mean() <= promise.high


def missed(promise: Promise | None, result: Evaluation) -> bool:
    """Whether the mean return of an evaluation lies below the promised interval; False without a promise."""
    return promise is not None and bool(result.returns.mean() < promise.low)


@dataclass(frozen=True)
class Imagining:
    """What virtual episodes of the evaluated policy need: the policy, its card, the server's token and a seed."""

    load: Callable[[], Predict]
    card: PolicyCard
    token: str | None
    seed: int = 0

    def changes(self, api: Api, view: SurrogateView, shifted: Systematic, weights: Any) -> Any:
        """Return the changes (K,) of the mean return of virtual episodes that K errors of the surrogate's model cause.
        ``shifted`` names the outputs and standardises the inputs; ``weights`` (K, O, 1 + P) has for each error and
        output a constant and a factor for each of P inputs."""
        from surrogym_client.transport import HttpSurrogate
        from surrogym_trainer.evaluation.comparing import EFFECT_STARTS, changes_of
        from surrogym_trainer.policies.integrals import with_integrals
        from surrogym_trainer.training.cards import session_of

        assert view.model_version is not None
        session = session_of(self.card, view)
        with HttpSurrogate(api.url, view.name, self.token) as http:
            port = with_integrals(http, self.card.integral, self.card.set_points)
            return changes_of(
                port, self.load(), self.seed, session, view.model_version, shifted, weights, EFFECT_STARTS
            )


def _compare(api: Api, surrogate: str, result: Evaluation, first_seed: int, imagining: Imagining) -> Differing | None:
    """Compare the real steps of an evaluation with a surrogate's model. Returns None if there is no model, or if its
    coordinates are not those of the episodes."""
    import numpy as np

    from surrogym_trainer.evaluation.comparing import (
        Disagreements,
        compared,
        disagreements,
        effects_of,
        steady,
        steps_of,
    )

    view = api.surrogate(surrogate)
    if view.fidelity is None or result.trace.coordinates.shape[1] != len(view.spec.coordinates):
        return None
    known = [step for step in steps_of(result.traces) if view.spec.known(step.coordinates)]
    steps = steady(view.spec, known)
    left_out = len(known) - len(steps)
    if not steps:
        return Differing(Disagreements(0, (), {}), first_seed, changed=result.varied, left_out=left_out)
    beside = compared(api, view.spec, view, steps)
    # the server can add errors to a model of coordinates only, not to one of observations
    takes_residual = view.spec.preset.moves == "coordinates"
    changes = partial(imagining.changes, api, view) if takes_residual else None
    effects, share = effects_of(view.spec, beside, changes)
    explaining = tuple(steps[i] for i in np.argsort(-share).tolist() if share[i] > 0)
    found = replace(disagreements(steps, beside), shared=explaining)
    return Differing(found, first_seed, effects=tuple(effects), changed=result.varied, left_out=left_out)


def _not_compared(first_seed: int, why: str) -> Differing:
    """Return a result without disagreements, because no step was compared, with the reason (``why``)."""
    from surrogym_trainer.evaluation.comparing import Disagreements

    return Differing(Disagreements(0, (), {}), first_seed, without=why)


def _await_model(server: str | None, token: str | None, surrogate: str, seconds: float, *, quiet: bool) -> None:
    """Wait until the server has fitted a model to all samples. If that fails or takes too long, print the reason."""
    from surrogym_client.errors import SurrogymClientError
    from surrogym_client.surrogates.waiting import DesignUnfinished, words_of_design

    try:
        await_model(server, token, surrogate, seconds, lambda view, _: words_of_design(view), quiet=quiet)
    except DesignUnfinished as error:
        say(str(error), quiet=quiet)
    except SurrogymClientError as error:
        say(f"the steps are stored; not waited for the model of {surrogate!r}: {error}", quiet=quiet)


@dataclass(frozen=True)
class Differing:
    """Result of comparing real steps with the model.

    Attributes:
        found: the real steps that differ from the model.
        first_seed: reset seed of the first episode; each further episode has the next seed.
        learned: number of steps that were added to the surrogate's samples.
        all_steps: whether all real steps were added, and not only those that differ.
        changed: names of the constants that changed within an episode.
        left_out: number of steps in which such a constant changed. They are not compared, because the model assumes
            that constants don't change.
        without: reason why no step was compared; empty if steps were compared.
        effects: outputs whose errors have a part that all steps share.
        broken: whether the mean return is below the promised interval.
    """

    found: Disagreements
    first_seed: int
    learned: int = 0
    changed: tuple[str, ...] = ()
    left_out: int = 0
    all_steps: bool = False
    without: str = ""
    effects: tuple[Effect, ...] = ()
    broken: bool = False

    def in_words(self, spec: EnvironmentSpec | None) -> list[str]:
        """Describe the result: a line about all steps, and a line for each of the episodes and of the steps that differ
        most from the model."""
        from surrogym_trainer.evaluation.comparing import SHOWN

        found = self.found
        if self.without:
            return [f"not compared with a model: {self.without}", *self._learned()]
        if not found.found:
            return [*self._none(), *self._together(), *self._left_out(), *self._learned()]
        count = len(found.found)
        lines = [
            f"{count} of {found.compared} real steps differ{'s' * (count == 1)} from the model by more than the "
            "model's uncertainty"
        ]
        for episode, count in list(found.by_episode().items())[:SHOWN]:
            more = found.missing.get(episode, 0.0)
            earned = f"its compared steps earned {abs(more):.4g} {'less' if more < 0 else 'more'} than predicted"
            if episode in found.as_predicted:
                earned = "its compared steps earned what was predicted, so a loss comes from the states they lead to"
            lines.append(
                f"  episode of seed {self.first_seed + episode}: {count} such step{'s' * (count > 1)}; {earned}"
            )
        names = () if spec is None else spec.coordinate_names
        lines += [f"  {self._at(one, names)}" for one in found.found[:SHOWN]]
        return [*lines, *self._together(), *self._left_out(), *self._learned()]

    def _none(self) -> list[str]:
        """Return lines for a comparison in which no single step differs from the model. If the mean return is below
        the promised interval, the lines say that no single step explains it."""
        none = f"none of {self.found.compared} real steps differs from the model by more than the model's uncertainty"
        if not self.broken:
            return [] if self.effects else [none]
        if self.effects:
            return ["no single step shows why the return is below the promise"]
        return [
            f"the compared steps do not explain why the return is below the promise: {none}, and together they show no "
            "error either; a hidden state or other starts would"
        ]

    def _together(self) -> list[str]:
        """Return lines about the outputs whose errors have a part that all steps share; empty if there is none."""
        if not self.effects:
            return []
        return [f"{self.found.compared} real steps together:", *(f"  {one.words()}" for one in self.effects)]

    def as_json(self) -> dict[str, Any]:
        """Return the result of the comparison as values that JSON can represent."""
        counts = self.found.by_episode()
        return {
            "compared": self.found.compared,
            "left_out": self.left_out,
            "learned": self.learned,
            "together": [asdict(one) | {"region": one.region and one.region._asdict()} for one in self.effects],
            "episodes": [
                {"seed": self.first_seed + episode, "steps": counts.get(episode, 0), "missing_reward": missing}
                for episode, missing in self.found.missing.items()
            ],
            "steps": [
                {
                    "seed": self.first_seed + one.step.episode,
                    "step": one.step.number,
                    "coordinates": list(one.step.coordinates),
                    "action": list(one.step.action),
                    "output": one.output,
                    "error": one.error,
                    "claimed": one.claimed,
                }
                for one in self.found.found
            ],
        }

    def _left_out(self) -> list[str]:
        """Return a line with the number of steps that were not compared; empty if all were compared."""
        if not self.left_out:
            return []
        steps = "1 real step, in which" if self.left_out == 1 else f"{self.left_out} real steps, in each of which"
        names = " or ".join(self.changed) or "a constant"
        return [f"not compared: {steps} {names} changed, because the model keeps it constant"]

    def _learned(self) -> list[str]:
        """Return a line with the number of steps that the model learns from; empty if there are none."""
        if not self.learned:
            return []
        which = "real steps" if self.all_steps else "of these steps"
        return [f"the model learns from {self.learned} {which}; train again in the new model"]

    def _at(self, one: Disagreement, names: Sequence[str]) -> str:
        count = len(one.step.coordinates)
        known = names if len(names) == count else [f"q{i}" for i in range(count)]
        state = ", ".join(f"{name} {value:.4g}" for name, value in zip(known, one.step.coordinates, strict=True))
        return (
            f"seed {self.first_seed + one.step.episode}, step {one.step.number}, at {state}: {one.output} is "
            f"{one.error:+.3g} off the prediction, whose standard deviation is {one.claimed:.3g}"
        )
