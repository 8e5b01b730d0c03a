"""Comparison of real steps with a model's predictions: the steps at which the two disagree, and the effect on a
policy's imagined return of the model errors that these steps have shown.

Shapes: n steps, O outputs, C coordinates, P inputs, K rows of weights, each for one possible error of the model.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from surrogym_client.transport.api import Api
from surrogym_shared.port import SurrogatePort
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import OF_PARTICLES, NewSample, OutputFidelity, SurrogateView
from surrogym_trainer.evaluation.audit import ALARM, SHIFT_ALARM, Compared, chi_squared, differences
from surrogym_trainer.evaluation.evaluator import ROUNDING, Trace, span
from surrogym_trainer.evaluation.imagined import imagine
from surrogym_trainer.evaluation.systematic import LEAST, Inputs, Region, Systematic, region
from surrogym_trainer.policies.predict import Predict

MOST = 400  # at most this number of real steps is compared with the model
# an output's expected error, in its unit, is taken to be at least this, so that an output without any error can be
# tested
LEAST_ERROR = 1e-12
SHOWN = 3  # at most this number of the worst steps, and of the worst episodes, is shown


class Step(Protocol):
    """One real step, from a sample or from an episode."""

    @property
    def coordinates(self) -> Any: ...
    @property
    def action(self) -> Any: ...
    @property
    def next_coordinates(self) -> Any: ...
    @property
    def reward(self) -> float: ...
    @property
    def terminated(self) -> bool: ...


def compared(
    api: Api, spec: EnvironmentSpec, view: SurrogateView, samples: Sequence[Step], matters: float = 0.0
) -> Compared:
    """Return real steps together with the predictions of a surrogate's model, which was not fitted to them.

    Args:
        api: the connection to the server.
        spec: the specification.
        view: the surrogate, with its model version.
        samples: the real steps.
        matters: error of the reward up to which the return hardly changes.
    """
    q, u = [list(sample.coordinates) for sample in samples], [list(sample.action) for sample in samples]
    predicted = api.predict(view.name, q, u, model=view.model_version)
    uncertain = api.query_uncertainty(view.name, q, u, model=view.model_version)
    moved = differences(
        spec, np.array([sample.next_coordinates for sample in samples]), np.array(predicted.next_coordinates)
    )
    rewards = np.array([sample.reward for sample in samples]) - np.array(predicted.reward)
    columns = {coordinate.name: moved[:, i] for i, coordinate in enumerate(spec.coordinates)} | {"reward": rewards}
    assert view.fidelity is not None
    claims = [output for output in view.fidelity.outputs if output.name in columns]
    deviations = np.array(uncertain.deviation)[:, [uncertain.outputs.index(claim.name) for claim in claims]]
    ended, foreseen = np.array([sample.terminated for sample in samples]), np.array(predicted.terminated)
    return Compared(
        names=[claim.name for claim in claims],
        errors=np.stack([columns[claim.name] for claim in claims], 1),
        deviations=deviations,
        expected=np.array([_expected(claim, matters if claim.name == "reward" else 0.0) for claim in claims]),
        claimed_alone=np.array([_alone(claim) for claim in claims]),
        states=np.array(q),
        actions=np.array(u),
        misplaced=int((ended != foreseen).sum()),
        cut_short=spec.query == "rollout" and bool((ended & ~foreseen).any()),
    )


def _expected(claim: OutputFidelity, matters: float) -> float:
    """Return the error of an output that is allowed besides the predicted deviation: the largest of its tolerance, its
    error on left-out samples, and ``matters``."""
    return max(claim.tolerance, claim.leave_one_out_error or 0.0, matters)


def _alone(claim: OutputFidelity) -> float:
    """Return the error of an output on left-out samples, which includes the noise, but at least ``LEAST`` times the
    tolerance. If the family of models can't compute this error, return the output's tolerance."""
    known = claim.tolerance if claim.leave_one_out_error is None else claim.leave_one_out_error
    return max(known, claim.noise, LEAST * claim.tolerance, LEAST_ERROR)


@dataclass(frozen=True)
class StepOfEpisode:
    """One real step, with the number of its episode and its own number in the episode, both from 0."""

    episode: int
    number: int
    coordinates: tuple[float, ...]
    action: tuple[float, ...]
    next_coordinates: tuple[float, ...]
    reward: float
    terminated: bool


def steps_of(traces: Sequence[Trace], most: int = MOST) -> list[StepOfEpisode]:
    """Return at most ``most`` evenly spaced steps of episodes."""
    places = [(episode, t) for episode, trace in enumerate(traces) for t in range(len(trace.reward))]
    kept = np.unique(np.linspace(0, len(places) - 1, min(len(places), most)).astype(int))
    return [_step(traces[episode], episode, t) for episode, t in (places[i] for i in kept)]


def steady(spec: EnvironmentSpec, steps: Sequence[StepOfEpisode]) -> list[StepOfEpisode]:
    """Return the steps in which no constant coordinate, such as a setpoint, changed. The other steps can't be
    predicted, because the model keeps constants."""
    held = [(i, ROUNDING * span(c)) for i, c in enumerate(spec.coordinates) if c.kind == "constant"]
    return [one for one in steps if all(abs(one.next_coordinates[i] - one.coordinates[i]) <= most for i, most in held)]


def _step(trace: Trace, episode: int, t: int) -> StepOfEpisode:
    last = t == len(trace.reward) - 1
    return StepOfEpisode(
        episode=episode,
        number=t,
        coordinates=tuple(map(float, trace.coordinates[t])),
        action=tuple(map(float, trace.action[t])),
        next_coordinates=tuple(map(float, trace.coordinates[t + 1])),
        reward=float(trace.reward[t]),
        terminated=last and trace.terminated,
    )


@dataclass(frozen=True)
class Disagreement:
    """A real step that contradicts the model: its worst output, the error of that output, and the standard deviation
    that is allowed for the error."""

    step: StepOfEpisode
    output: str
    error: float
    claimed: float


@dataclass(frozen=True)
class Disagreements:
    """The disagreements between a model and real episodes.

    Attributes:
        compared: number of real steps that were compared.
        found: steps whose error exceeds the one that the model predicts, by more than chance; the worst first.
        missing: sum of real minus predicted rewards over the compared steps of each episode, by the episode's number.
        shared: further steps that contribute most to an error that all steps share, the largest first.
        as_predicted: numbers of the episodes whose entry in ``missing`` is within the errors that the model claims.
    """

    compared: int
    found: tuple[Disagreement, ...]
    missing: dict[int, float]
    shared: tuple[StepOfEpisode, ...] = ()
    as_predicted: frozenset[int] = frozenset()

    def by_episode(self) -> dict[int, int]:
        """Return the number of steps that contradict the model, by episode, the largest first."""
        counts: dict[int, int] = {}
        for one in self.found:
            counts[one.step.episode] = counts.get(one.step.episode, 0) + 1
        return dict(sorted(counts.items(), key=lambda item: -item[1]))


def disagreements(steps: Sequence[StepOfEpisode], beside: Compared) -> Disagreements:
    """Find the steps whose error is larger than chance explains, at a level of 1 % for all of them together.

    Args:
        steps: the real steps.
        beside: the same steps with the model's predictions.
    """
    n, count = beside.errors.shape
    limit = sqrt(chi_squared(1, ALARM / (n * count)))
    ratio = np.abs(beside.errors) / beside.claimed
    worst = ratio.argmax(1)
    order = [i for i in np.argsort(-ratio.max(1)).tolist() if ratio[i].max() > limit]
    found = tuple(
        Disagreement(
            steps[i], beside.names[worst[i]], float(beside.errors[i, worst[i]]), float(beside.claimed[i, worst[i]])
        )
        for i in order
    )
    missing: dict[int, float] = {}
    claimed: dict[int, float] = {}  # by episode: sum of the claimed errors of the rewards
    if "reward" in beside.names:
        reward = list(beside.names).index("reward")
        pairs = zip(steps, beside.errors[:, reward].tolist(), beside.claimed[:, reward].tolist(), strict=True)
        for step, error, claim in pairs:
            missing[step.episode] = missing.get(step.episode, 0.0) + error
            claimed[step.episode] = claimed.get(step.episode, 0.0) + claim
    as_predicted = frozenset(episode for episode, sum_ in missing.items() if abs(sum_) <= claimed[episode])
    return Disagreements(n, found, missing, as_predicted=as_predicted)


def samples_of(found: Disagreements, most: int) -> list[NewSample]:
    """Return at most ``most`` of the steps as samples: first those that disagree by themselves, then those that explain
    an error that all steps share.

    Of either kind, the worst step of each episode comes first, then the second worst, and so on. Neighbours in one
    episode often err for the same reason, so the episodes take turns.
    """
    alone = [one.step for one in found.found]
    known = {(step.episode, step.number) for step in alone}
    shared = [step for step in found.shared if (step.episode, step.number) not in known]
    return as_samples([*_in_turns(alone), *_in_turns(shared)][:most])


def _in_turns(steps: Sequence[StepOfEpisode]) -> list[StepOfEpisode]:
    """Return the steps in another order: the first step of every episode, then the second step of every episode, and so
    on."""
    rank: dict[int, int] = {}
    turns: list[tuple[int, StepOfEpisode]] = []
    for step in steps:
        turn = rank[step.episode] = rank.get(step.episode, 0) + 1
        turns.append((turn, step))
    return [step for _, step in sorted(turns, key=lambda item: item[0])]


def as_samples(steps: Sequence[StepOfEpisode]) -> list[NewSample]:
    """Return the steps as samples to send to a server."""
    return [
        NewSample(
            coordinates=list(step.coordinates),
            action=list(step.action),
            next_coordinates=list(step.next_coordinates),
            reward=step.reward,
            terminated=step.terminated,
        )
        for step in steps
    ]


# If all real steps that test a policy's model share an error, the error's effect on the return is computed for this
# number of possible errors, which are drawn from the posterior distribution.
DRAWS = 64
STARTS = 4  # to see the effect of one error of the model, the return is the mean over this number of virtual episodes
# an output is reported only if the probability that its errors have a part that all steps share exceeds this
CERTAIN = 0.9
# for the reported effect of one output's errors, the return is the mean over this number of virtual episodes
EFFECT_STARTS = 32

Array = NDArray[np.float64]


def changes_of(
    port: SurrogatePort,
    predict: Predict,
    seed: int,
    session: Mapping[str, Any],
    version: int,
    shifted: Systematic,
    weights: Array,
    starts: int = STARTS,
) -> Array:
    """Return the changes (K,) of the policy's mean return in the model if each of K errors is added to the model's
    outputs.

    The episodes with and without the errors have the same starts and the same noise, and follow the model's mean.

    Args:
        port: the interface of the surrogate.
        predict: the policy.
        seed: seed of the starts and the noise.
        session: fields of ``OpenSession`` that the policy was trained with.
        version: version of the model that was compared with the real steps.
        shifted: the test for errors that all steps share, which names the outputs and standardises the inputs.
        weights: the K errors (K, O, 1 + P): for each output, a constant and a factor for each of P standardised inputs.
        starts: number of virtual episodes for each of the K errors.
    """
    if not weights.any():
        return np.zeros(len(weights))
    spec = port.spec()
    outputs = [coordinate.name for coordinate in spec.coordinates if coordinate.moves] + ["reward"]
    placed = np.zeros((len(weights), len(outputs), weights.shape[2]))
    placed[:, [outputs.index(name) for name in shifted.names]] = weights
    left_out = {"variant", "functions", "penalty", *OF_PARTICLES}
    options = {name: value for name, value in session.items() if name not in left_out}
    options |= {"variant": "deterministic", "penalty": 0.0, "model": version}
    lanes = len(weights) * starts
    usual = imagine(port, predict, lanes, seed, **options).returns
    changed = imagine(port, predict, lanes, seed, **options, residual=shifted.inputs.residual(placed)).returns
    changes: Array = (changed - usual).reshape(starts, len(weights)).mean(0)
    return np.where(weights.any((1, 2)), changes, 0.0)


@dataclass(frozen=True)
class Effect:
    """An error of an output that all steps share, and its effect.

    Attributes:
        output: the output's name.
        error: mean of real minus predicted values, in the output's unit.
        region: range of an input in which the error is largest; None if it is much the same everywhere.
        change: change of the imagined return by the error; None if it was not computed.
    """

    output: str
    error: float
    region: Region | None
    change: float | None

    def words(self) -> str:
        """Return a sentence about the output's error, where it is largest, and how much it changes the return."""
        where = ""
        if (at := self.region) is not None:
            where = f", {at.error:+.3g} where {at.name} is between {at.low:.4g} and {at.high:.4g}"
        cost = "" if self.change is None else f"; in the model this changes the return by {self.change:+.4g}"
        return f"{self.output} is {self.error:+.3g} off the prediction on average{where}{cost}"


def effects_of(
    spec: EnvironmentSpec, compared: Compared, change: Callable[[Systematic, Array], Array] | None
) -> tuple[list[Effect], Array]:
    """Find the outputs whose errors have a part that all steps share. The output whose error has the largest effect on
    the return comes first.

    Args:
        spec: specification of the environment.
        compared: the real steps with their predictions.
        change: computes the changes (K,) of the return that K errors cause, each given by weights (O, 1 + P); None
            leaves the changes out.

    Returns:
        The effects, and the contribution (n,) of each step to them: the sum of its errors in the direction of the
        shared errors, each divided by the model's error on left-out samples and weighted by the size of the effect.
    """
    shifted = compared.together(spec, Inputs.over(spec, compared.states, compared.actions))
    weights, outputs = shifted.expected(), np.flatnonzero(shifted.chances > CERTAIN).tolist()
    if shifted.evidence < 1 / SHIFT_ALARM or not len(outputs):
        return [], np.zeros(len(compared.errors))
    alone = np.zeros((len(outputs), *weights.shape))
    for row, output in enumerate(outputs):
        alone[row, output] = weights[output]
    changes = [None] * len(outputs) if change is None else change(shifted, alone).tolist()
    names = [*spec.coordinate_names, *(f"action {i}" for i in range(spec.action.size))]
    at = np.concatenate([compared.states, compared.actions], 1)
    found = [
        Effect(compared.names[o], float(errors.mean()), region(names, at, errors), moved)
        for o, errors, moved in zip(outputs, compared.errors.T[outputs], changes, strict=True)
    ]
    explained = shifted.inputs.at(spec, compared.states, compared.actions) @ weights[outputs].T
    importance = np.array([1.0 if moved is None else abs(moved) for moved in changes])
    importance = importance / max(float(importance.max()), 1e-300)
    along = np.sign(explained) * compared.errors[:, outputs] / compared.claimed_alone[outputs]
    share = (np.maximum(along, 0.0) * importance).sum(1)
    return sorted(found, key=lambda one: -abs(one.change or 0.0)), share
