"""Evaluation of a policy in the original environment, from the declared starts and, if the task has further starts,
from those as well."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from surrogym.demo.settings import DemoSettings
from surrogym.demo.tasks import Outcome
from surrogym_sampler.original import make
from surrogym_sampler.original.episode import Episode
from surrogym_sampler.original.episodes import open_episode
from surrogym_shared.terminal import progress
from surrogym_shared.wire import Controller
from surrogym_shared.words import counted
from surrogym_trainer.evaluation.baselines import baseline, default_baseline
from surrogym_trainer.evaluation.evaluator import Evaluation, EvaluationSettings, evaluate
from surrogym_trainer.policies.card import read_card
from surrogym_trainer.policies.files import load_policy

COMPARED = 20  # number of the policy's starts from which episodes without the policy run as well


@dataclass(frozen=True)
class Part:
    """Part of an evaluation: real episodes of one controller, and the settings of their starts."""

    controller: Controller
    settings: EvaluationSettings
    result: Evaluation


@dataclass(frozen=True)
class Judgement:
    """Results of a policy's evaluation in a demo: from the declared starts (``real``), from the task's other starts
    (``also``, or None), and without the policy, from the first declared starts (``without``)."""

    real: Part
    also: Part | None
    without: Part
    reached: bool  # whether the results reach the target of the task

    @property
    def parts(self) -> list[Part]:
        return [part for part in (self.real, self.also, self.without) if part is not None]

    @property
    def results(self) -> tuple[Evaluation, Evaluation | None, Evaluation]:
        """Results of the policy, of the policy from the task's other starts (or None), and without the policy."""
        return self.real.result, None if self.also is None else self.also.result, self.without.result

    @property
    def steps(self) -> int:
        """Number of real steps of all episodes."""
        return sum(part.result.steps for part in self.parts)

    @property
    def episodes(self) -> int:
        return sum(part.settings.episodes for part in self.parts)


def judge(settings: DemoSettings, policy: Path, *, quiet: bool) -> Judgement:
    """Evaluate a policy file by real episodes of the demo's task, also without the policy, for comparison."""
    task, starts = settings.demo_task, settings.demo_task.also
    plain = EvaluationSettings(episodes=settings.episodes)
    with progress("evaluate", quiet=quiet) as update:
        update(0.0, "loading the policy")
        predict = load_policy(policy, read_card(policy).algorithm)
        opener = episodes_of(settings)

        def look(share: float, ended: int) -> None:
            update(share, f"{counted(plain.episodes, 'real episode')}, {ended} terminated")

        real = Part("policy", plain, evaluate(predict, opener, plain, look))
        also = None
        if starts is not None:
            other = EvaluationSettings(episodes=settings.episodes, wide=starts.wide, start_scale=starts.scale)
            also = Part("policy", other, evaluate(predict, opener, other, look))
        few, spec = EvaluationSettings(episodes=min(COMPARED, settings.episodes)), settings.judged_by()
        left_alone = default_baseline(spec)
        without = Part(left_alone, few, evaluate(baseline(spec, left_alone, settings.seed), opener, few))
    reached = task.target.reached(_outcome(real.result), None if also is None else _outcome(also.result))
    return Judgement(real, also, without, reached)


def episodes_of(settings: DemoSettings) -> Callable[[], Episode]:
    """Return a function that opens an episode of the demo's original environment."""
    name, spec = settings.demo_task.environment, settings.judged_by()
    return partial(open_episode, name, spec, partial(make, name, spec=spec))


def _outcome(result: Evaluation) -> Outcome:
    return Outcome(float(result.returns.mean()), float(result.returns.min()), result.success_rate)
