"""What a policy is worth: episodes in the original environment, from its own starts and, where the task has others,
from those as well."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from surrogym_client.evaluation.evaluator import Evaluation, EvaluationSettings, evaluate
from surrogym_client.experiments.settings import DemoSettings
from surrogym_client.experiments.tasks import Outcome
from surrogym_client.original import make
from surrogym_client.original.episodes import Episode, open_episode
from surrogym_client.policies.card import read_card
from surrogym_client.policies.files import load_policy
from surrogym_shared.terminal import progress


@dataclass(frozen=True)
class Judgement:
    """``also`` is from the task's other starts, None where it has none."""

    real: Evaluation
    also: Evaluation | None
    reached: bool  # the task's target

    @property
    def steps(self) -> int:
        """Real steps taken."""
        return self.real.steps + (0 if self.also is None else self.also.steps)

    @property
    def episodes(self) -> int:
        return len(self.real.returns) + (0 if self.also is None else len(self.also.returns))


def judge(settings: DemoSettings, policy: Path, *, quiet: bool) -> Judgement:
    """Evaluate a policy file."""
    task, starts = settings.demo_task, settings.demo_task.also
    plain = EvaluationSettings(episodes=settings.episodes)
    with progress("evaluate", quiet=quiet) as update:
        update(0.0, "loading the policy")
        predict = load_policy(policy, read_card(policy).algorithm)
        opener = episodes_of(settings)

        def look(share: float, ended: int) -> None:
            update(share, f"{plain.episodes} real episodes, {ended} terminated")

        real = evaluate(predict, opener, plain, look)
        also = None
        if starts is not None:
            other = EvaluationSettings(episodes=settings.episodes, wide=starts.wide, start_scale=starts.scale)
            also = evaluate(predict, opener, other, look)
    reached = task.target.reached(_outcome(real), None if also is None else _outcome(also))
    return Judgement(real, also, reached)


def episodes_of(settings: DemoSettings) -> Callable[[], Episode]:
    """Opens episodes of the original environment."""
    name, spec = settings.demo_task.environment, settings.judged_by()
    return partial(open_episode, name, spec, partial(make, name, spec=spec))


def _outcome(result: Evaluation) -> Outcome:
    return Outcome(float(result.returns.mean()), float(result.returns.min()), result.success_rate)
