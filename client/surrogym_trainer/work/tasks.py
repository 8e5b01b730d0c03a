"""The execution of jobs by a worker, with the code of ``surrogym train`` and ``surrogym evaluate``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from uuid import uuid4

from surrogym_client.environments.pictures import NotRenderable
from surrogym_client.transport import HttpSurrogate
from surrogym_client.transport.api import Api
from surrogym_sampler.original.episode import Episode
from surrogym_sampler.original.errors import EvaluationFailed
from surrogym_shared import wire
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.words import counted
from surrogym_trainer.evaluation.baselines import baseline
from surrogym_trainer.evaluation.evaluator import (
    Evaluation,
    EvaluationInterrupted,
    EvaluationSettings,
    evaluate,
    for_set_points,
)
from surrogym_trainer.evaluation.reporting import as_reported, counts_of_limits, paired_start, words_of
from surrogym_trainer.evaluation.videos import record
from surrogym_trainer.policies.card import set_points_in, write_card
from surrogym_trainer.policies.files import load_policy
from surrogym_trainer.policies.integrals import acting_with_integrals
from surrogym_trainer.policies.predict import Acting, Predict
from surrogym_trainer.training.audited import AuditedTraining
from surrogym_trainer.training.cards import card_of
from surrogym_trainer.training.handover import AuditSettings, Handover
from surrogym_trainer.training.search import SEARCHES, name_of, with_algorithm
from surrogym_trainer.training.settings import TrainingInterrupted, TrainResult, TrainSettings
from surrogym_trainer.work.reporter import Reporter

QUICK = 4  # a quick training takes the suggested number of steps of the algorithm, divided by this


@dataclass(frozen=True)
class Environment:
    """The original environment in which a worker evaluates policies.

    Attributes:
        spec: its specification.
        opener: opens an episode in it.
        most_episodes: largest number of real episodes in one job.
        name: name of the environment that draws pictures of its states; empty if there are no pictures.
        reference: loads the reference controller for one job; None if there is none.
    """

    spec: EnvironmentSpec
    opener: Callable[[], Episode]
    most_episodes: int
    name: str = ""
    reference: Callable[[], Acting] | None = None


@dataclass
class Gathered:
    """The results of a job so far, which are kept even if the job is stopped or fails."""

    policy: Path | None = None
    version: int | None = None
    video: Path | None = None
    lacks: str | None = None  # why the requested video could not be made; None if it was made, or not requested
    evaluations: list[wire.AddEvaluation] = field(default_factory=list)
    steps: list[wire.ReportSteps] = field(default_factory=list)


def settings_of(task: wire.TrainTask, spec: EnvironmentSpec) -> TrainSettings:
    """Return the settings of a training task. Raises ``ValueError`` if the algorithm is not installed."""
    asked = TrainSettings(algorithm=task.algorithm, total_steps=task.steps, seed=task.seed)
    settings = with_algorithm(asked, spec)
    if task.preset != "quick":
        return settings
    return replace(settings, total_steps=SEARCHES.get(name_of(settings)).suggested_steps // QUICK, prolong=False)


def train(
    api: Api, port: HttpSurrogate, task: wire.TrainTask, out: Path, reporter: Reporter, gathered: Gathered
) -> None:
    """Train a policy, and write it with its card.

    Args:
        api: the connection to the server.
        port: the interface of the surrogate.
        task: the training task.
        out: file to write the policy to.
        reporter: reports the progress.
        gathered: receives the policy's file.

    Raises:
        KeyboardInterrupt: the training was stopped. If there was a policy by then, it is in ``gathered``.
        ValueError: the settings don't fit the search.
        SurrogymClientError: the server can't be reached, or refuses a request.
    """
    name, spec = port.surrogate, port.spec()

    def keep(result: TrainResult, handover: Handover | None = None) -> None:
        curve = reporter.stand.curve
        card = card_of(result, handover, surrogate=name, spec=spec, url=api.url, seed=task.seed, curve=curve)
        write_card(result.path, card)
        gathered.policy = result.path

    training = AuditedTraining(
        api,
        name,
        port,
        out,
        settings_of(task, spec),
        audit=AuditSettings(seed=task.seed) if task.audit else None,
        progress=reporter.trained,
        waiting=lambda _: reporter.at("auditing"),
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    try:
        keep(*training.train())
    except TrainingInterrupted as interruption:
        keep(interruption.result)
        raise


def run_episodes(
    api: Api,
    surrogate: str,
    task: wire.EvaluateTask,
    environment: Environment,
    folder: Path,
    reporter: Reporter,
    gathered: Gathered,
) -> None:
    """Run real episodes of a stored policy, and of the controllers that it is compared with. Then draw a video, if the
    task requests one.

    The real steps are in ``gathered`` even if the episodes fail or are stopped.

    Args:
        api: the connection to the server.
        surrogate: name of the surrogate.
        task: the evaluation task.
        environment: the original environment.
        folder: folder for the policy's file and the video.
        reporter: reports the progress.
        gathered: receives evaluations, real steps and the video.

    Raises:
        ValueError: the task has more episodes than the worker allows, or requests a reference controller that it lacks.
        PolicyMisfit: the environment is not the one that the surrogate's policies were trained for; it was not reset.
        UnusablePolicy: the file can't be read without running code in it.
        KeyboardInterrupt: the evaluation was stopped.
        EvaluationFailed: the environment or the policy raised an error after real steps.
    """
    if task.real_episodes > environment.most_episodes:
        raise ValueError(
            f"expected at most {counted(environment.most_episodes, 'real episode')}, got {task.real_episodes}: "
            "ask for fewer, or start the worker with a larger --most-episodes"
        )
    found = api.policies.get(surrogate, task.policy)
    gathered.version = found.version
    settings = EvaluationSettings(task.episodes, task.first_seed, task.wide)
    trained_for = api.surrogate(surrogate).spec
    points, integral = set_points_in(found.settings), tuple(found.settings.get("integral") or ())
    policy = acting_with_integrals(_loaded(api, surrogate, found, folder), trained_for, integral, points)
    controllers = _controllers(task, environment, policy)
    results: dict[wire.Controller, Evaluation] = {}
    for done, (controller, predict) in enumerate(controllers.items()):

        def tell(share: float, _: int, done: int = done) -> None:
            reporter.at("evaluating", (done + share) / len(controllers))

        result = _counted(predict, environment, settings, controller, tell, gathered, trained_for)
        results[controller] = for_set_points(result, trained_for, points)
    paired = paired_start(results["policy"], min(len(result.returns) for result in results.values()))
    gathered.evaluations = [
        as_reported(
            result,
            settings,
            uuid4().hex,
            environment=environment.name,
            trained_for=trained_for,
            controller=controller,
            paired=paired,
        )
        for controller, result in results.items()
    ]
    if task.video:
        path = folder / f"{surrogate}-{found.version}-{uuid4().hex[:8]}"
        gathered.video, gathered.lacks = _filmed(environment, results["policy"], settings, path)


def _controllers(task: wire.EvaluateTask, environment: Environment, policy: Acting) -> dict[wire.Controller, Acting]:
    """Return the controllers to run, by kind, the policy first."""
    controllers: dict[wire.Controller, Acting] = {"policy": policy}
    if task.compare is not None:
        controllers[task.compare] = baseline(environment.spec, task.compare)
    if task.reference:
        if environment.reference is None:
            raise ValueError("this worker has no reference controller: start it with --reference")
        controllers["reference"] = environment.reference()
    return controllers


def _filmed(
    environment: Environment, result: Evaluation, settings: EvaluationSettings, path: Path
) -> tuple[Path | None, str | None]:
    """Write a video. Return its file, or the reason why it could not be made: a video that fails must not fail the
    evaluation."""
    try:
        video = record(environment.spec, environment.name, result, words_of(settings))
    except NotRenderable as error:
        return None, f"no video: {error}"
    except Exception as error:  # a user's environment may raise anything when it is drawn
        return None, f"no video: {type(error).__name__}: {error}"
    file = path.with_name(f"{path.name}.{video.form}")
    file.write_bytes(video.content)
    return file, None


def _counted(
    predict: Acting,
    environment: Environment,
    settings: EvaluationSettings,
    controller: wire.Controller,
    tell: Callable[[float, int], None],
    gathered: Gathered,
    trained_for: EnvironmentSpec,
) -> Evaluation:
    """Run the episodes of one controller, and record their real steps in ``gathered``."""

    def note(steps: int, episodes: int, what: str, limits: wire.LimitCounts | None = None) -> None:
        if steps:
            acting = "the reference controller" if controller == "reference" else f"{controller} actions"
            said = what if controller == "policy" else f"{what}, {acting}"
            gathered.steps.append(
                wire.ReportSteps(steps=steps, episodes=episodes, note=said, limits=limits, idempotency_key=uuid4().hex)
            )

    try:
        result = evaluate(predict, environment.opener, settings, tell, trained_for=trained_for)
    except EvaluationFailed as failure:
        note(failure.steps, 0, "failed")
        raise
    except EvaluationInterrupted as interruption:
        note(interruption.steps, 0, "interrupted")
        raise
    episodes = len(result.returns)  # fewer than asked for, if limits were left too often
    said = f"{counted(episodes, 'episode')} from seed {settings.first_seed}"
    note(result.steps, episodes, said, counts_of_limits(result.limits))
    return result


def _loaded(api: Api, surrogate: str, found: wire.PolicyDetail, folder: Path) -> Predict:
    """Download a policy's file, and load it without unpickling anything."""
    forms: list[wire.PolicyForm] = [file.form for file in found.files if file.stored and file.form in ("zip", "onnx")]
    if not forms:
        raise ValueError(
            f"expected a stored zip or onnx file of {surrogate}@{found.version}, got none: push the policy again"
        )
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{surrogate}-{found.version}.{forms[0]}"
    path.write_bytes(api.policies.file(surrogate, found.version, forms[0]))
    return load_policy(path, found.algorithm or "PPO")
