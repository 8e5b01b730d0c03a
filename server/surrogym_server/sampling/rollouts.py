"""Action sequences for an environment that can't be set to any state: first random, then planned in the model.

A sequence begins at a reset, or at a snapshot: a state to which the environment can return.

The value of a sequence is the acquisition's value per real step: for most acquisitions, the information that a path
gives about each output (``PathOutlook.information``). A step has weight 0 outside the sampling range and after the end
of an episode. The weight falls with the standard deviation accumulated along the path, so a plan ends where it can't be
predicted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.distributions import scaling
from surrogym_server.models.abilities import PathOutlook, PredictedSteps
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.acquisition import PathView, path_value_of
from surrogym_server.sampling.endings import edge_in_doubt, in_doubt
from surrogym_server.sampling.occupancy import log_occupancy
from surrogym_server.sampling.outlook import as_if_answered, path_outlook
from surrogym_shared.nouns import Query, Vector

STARTS = 6  # number of start states, drawn at random, from which each sequence is predicted
POPULATION = 48  # number of action sequences that are compared at once
ELITE = 12  # number of the best sequences, whose variations form the next population
GENERATIONS = 3  # number of populations in a search, the random first one included
DOUBTFUL = 0.25  # least chance of finding an unknown termination for which a rollout is planned

Sequences = NDArray[np.float64]  # k sequences of T actions, (k, T, F)
# Function that rates k sequences, each from s equally likely start states (k, s, C): it returns their values and best
# lengths, (k,) each.
Worth = Callable[[Tensor, Sequences], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Aim:
    """Objective and limits of a planned action sequence: which outputs to learn about, and where it may lead."""

    columns: Sequence[int]  # indices of the outputs about which the sequence should give information
    tolerances: Sequence[float]  # (O,) tolerance of every output, in its unit
    longest: int  # greatest number of actions in the sequence
    snapshots: Mapping[str, Vector] = field(default_factory=dict)  # states at which a sequence may begin, by name
    states: Tensor | None = None  # (v, C) states that policies visited; their density weights the information
    ending: bool = False  # whether a sequence that meets an unknown termination or reward edge has priority
    ended: bool = False  # whether a sample has ended an episode, so that a declared termination counts as known


@dataclass(frozen=True)
class Paths:
    """Predicted paths of the mean state: b paths of T steps."""

    q: Tensor  # (b, T, C) states before each step
    u: Tensor  # (b, T, F) actions
    q_next: Tensor  # (b, T, C) states after each step
    running: Tensor  # (b, T) 1 for steps of a running episode, 0 after its end or after a limit was approached
    ended: Tensor  # (b, T) 1 from the step that ends the episode, 0 before
    drift: Tensor  # (b, T) predictive variance summed over the steps before, in variances of the sampling range


def first_rollouts(definition: EnvironmentDefinition, steps: int, rng: np.random.Generator) -> tuple[Query, ...]:
    """Draw random sequences of 1, 2, 3, ... actions, with ``steps`` actions in total.

    Each sequence holds its actions for a different number of steps, so that the states spread. First steps from which a
    model does not learn, because lags are not known yet, come in addition.
    """
    rollouts: list[Query] = []
    while steps > definition.unknown_steps:
        length = min(len(rollouts) + 1 + definition.unknown_steps, steps, definition.max_rollout or 1)
        rollouts += map(Query.rollout, random_sequences(definition, 1, length, rng).tolist())
        steps -= length
    return tuple(rollouts)


def plan_round(
    model: DynamicsModel, aim: Aim, steps: int, unanswered: Sequence[Query], rng: np.random.Generator
) -> list[Query]:
    """Plan action sequences with ``steps`` real steps in total.

    Each sequence is planned as if the earlier ones and the unanswered queries had been answered.
    """
    rollouts: list[Query] = []
    latest = list(unanswered)
    while steps > model.definition.unknown_steps:
        for rollout in latest:
            model = as_if_done(model, rollout, aim.snapshots, rng)
        latest = [plan_rollout(model, replace(aim, longest=min(steps, aim.longest)), rng)]
        rollouts += latest
        steps -= latest[0].steps
        aim = replace(aim, ending=False)
    return rollouts


def plan_rollout(model: DynamicsModel, aim: Aim, rng: np.random.Generator) -> Query:
    """Plan the action sequence, from a reset or from the best snapshot, with the highest value per expected real step.

    The search compares random sequences of at most ``aim.longest`` actions, then variations of the best ones.
    """
    return best_rollout(model.definition, partial(_worth, model, aim), aim.longest, aim.snapshots, rng)


def best_rollout(
    definition: EnvironmentDefinition,
    worth: Worth,
    longest: int,
    snapshots: Mapping[str, Vector],
    rng: np.random.Generator,
) -> Query:
    """Search for the sequence of at most ``longest`` actions, from a reset or a snapshot, that the function ``worth``
    rates best."""
    starts = start_points(definition, STARTS, rng)[None]
    actions, _, value = _search(definition, worth, longest, starts, POPULATION, rng)
    if snapshots:
        origins = torch.tensor(list(snapshots.values()), dtype=torch.float64)[:, None]
        others, place, value_from_snapshot = _search(definition, worth, longest, origins, POPULATION * STARTS, rng)
        if value_from_snapshot > value:
            return Query.rollout(others.tolist(), list(snapshots)[place])
    return Query.rollout(actions.tolist())


def _search(
    definition: EnvironmentDefinition,
    worth: Worth,
    longest: int,
    origins: Tensor,
    population: int,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], int, float]:
    """Search for the best sequence (T, F) from any of k origins, each with s equally likely states (k, s, C).

    Return the sequence, the index of its origin, and its value.
    """
    sequences = random_sequences(definition, population, longest, rng)
    places = np.resize(rng.permutation(len(origins)), population)
    elite = population * ELITE // POPULATION
    value, length = worth(origins[places], sequences)
    for _ in range(GENERATIONS - 1):
        best_rows = value.argsort(descending=True)[:elite].numpy()
        parents = np.concatenate([best_rows, best_rows[rng.integers(elite, size=population - elite)]])
        sequences, places = sequences[parents], places[parents]
        vary(definition, sequences[elite:], rng)
        value, length = worth(origins[places], sequences)
    best = int(value.argmax())
    return sequences[best, : int(length[best])], int(places[best]), float(value[best])


def as_if_done(
    model: DynamicsModel, query: Query, snapshots: Mapping[str, Vector], rng: np.random.Generator
) -> DynamicsModel:
    """Condition the model on a rollout along its predicted path: variances shrink, means stay.

    If the query's snapshot is not among ``snapshots``, the path begins at a reset.
    """
    start = start_points(model.definition, 1, rng)
    if (at := snapshots.get(query.snapshot or "")) is not None:
        start = torch.tensor([at], dtype=torch.float64)
    path = predict_paths(model, start, torch.tensor([query.actions], dtype=torch.float64))
    learnable = (path.running[0] > 0) & model.definition.known(path.q[0])
    return as_if_answered(model, PredictedSteps(path.q[0, learnable], path.u[0, learnable], path.q_next[0, learnable]))


def start_points(definition: EnvironmentDefinition, count: int, rng: np.random.Generator) -> Tensor:
    """Draw states after a reset, (count, C), stratified over the declared start distribution."""
    columns = [
        c.start.quantile(torch.from_numpy((rng.permutation(count) + rng.random(count)) / count))
        for c in definition.coordinates
    ]
    if definition.counter is not None:
        columns[definition.counter] = torch.zeros(count, dtype=torch.float64)
    return torch.stack(columns, -1)


def random_sequences(definition: EnvironmentDefinition, count: int, length: int, rng: np.random.Generator) -> Sequences:
    """Draw piecewise constant sequences (count, length, F); the constant stretches last 1, 2, 4, ... steps."""
    times = 2 ** np.arange(int(np.log2(length)) + 1)
    sequences = np.empty((count, length, definition.action.size))
    for sequence in sequences:
        hold = int(rng.choice(times))
        values = _random_actions(definition, -(-length // hold), rng)
        sequence[:] = np.repeat(values, hold, axis=0)[:length]
    return sequences


def predict_paths(model: DynamicsModel, starts: Tensor, actions: Tensor) -> Paths:
    """Predict the path of the mean state from each start (b, C) under action sequences (b, T, F)."""
    definition = model.definition
    spread = starts.new_tensor([scaling(definition.coordinates[i].sampling)[1] for i in definition.moving])
    q, running, going = starts, starts.new_ones(len(starts)), starts.new_ones(len(starts))
    drift, variance = starts.new_zeros(len(starts)), starts.new_zeros(len(starts), len(spread))
    steps: list[tuple[Tensor, ...]] = []
    for u in actions.unbind(1):
        step = model.transition(q, u, stds=True)
        assert step.std is not None
        going = going * ~model.terminated(step.q_next)
        steps.append((q, u, step.q_next, running, 1 - going, drift))
        drift, variance = drift + (step.std / spread).square().sum(-1), variance + step.std.square()
        running = running * going * ~_may_leave_limits(definition, q, step.q_next, variance)
        q = step.q_next
    return Paths(*(torch.stack(column, 1) for column in zip(*steps, strict=True)))


def _may_leave_limits(definition: EnvironmentDefinition, q: Tensor, q_next: Tensor, variance: Tensor) -> Tensor:
    """Return which of b paths, with a step from q (b, C) to q_next (b, C), come too close to a limit, (b,) bool: the
    fallback action would take over, or they leave the limit with more than the allowed probability.

    ``variance`` (b, M) is the predictive variance of the moving coordinates, summed along each path.
    """
    if definition.limits is None or definition.moves_observation:
        return definition.falls_back(q, q_next)
    squares = q.new_zeros(())
    for column, index in enumerate(definition.moving):
        shift = torch.zeros_like(q_next)
        shift[:, index] = variance[:, column].sqrt()
        squares = squares + (definition.room(q_next + shift) - definition.room(q_next - shift)).square() / 4
    sure = torch.special.ndtri(q.new_tensor(1 - definition.limits.probability))
    unsafe = (definition.room(q_next) < sure * squares.sqrt()).any(-1)
    approached: Tensor = unsafe | definition.falls_back(q, q_next)
    return approached


def path_values(model: DynamicsModel, aim: Aim, paths: Paths) -> Tensor:
    """Return the acquisition's value of each path up to each step, (b, T), summed over the outputs in
    ``aim.columns``."""
    acquisition = model.definition.design.acquisition
    weight = _weights(model.definition, aim, paths)
    total = torch.zeros_like(weight)
    steps = PredictedSteps(paths.q, paths.u, paths.q_next)
    for column in aim.columns:
        if (output := path_outlook(model, steps, column)) is not None:
            total += path_value_of(acquisition, _view(output, weight * output.learns, aim.tolerances[column]))
    return total


def _view(output: PathOutlook, weight: Tensor, tolerance: float) -> PathView:
    """Return the properties of paths that an acquisition uses, for one output; ``weight`` (b, T) is that of each
    step."""
    return PathView(tolerance, weight, lambda: output.std, lambda: output.information(weight, tolerance))


def _worth(model: DynamicsModel, aim: Aim, starts: Tensor, sequences: Sequences) -> tuple[Tensor, Tensor]:
    """Rate the sequences (k, T, F), each from s equally likely states (k, s, C), by their best first part.

    Return the value per expected real step of that part, (k,), and its length, (k,).
    """
    count, lanes = starts.shape[:2]
    actions = torch.from_numpy(sequences).repeat_interleave(lanes, 0)
    paths = predict_paths(model, starts.flatten(0, 1), actions)
    gain = _endings(model, aim, paths) if aim.ending else paths.ended.new_zeros(1)
    if not bool((gain > DOUBTFUL).any()):
        gain = path_values(model, aim, paths)
    gains, costs = (x.reshape(count, lanes, -1).mean(1) for x in (gain, paths.running.cumsum(1)))
    best = (gains / costs).max(1)
    return best.values, best.indices + 1


def _endings(model: DynamicsModel, aim: Aim, paths: Paths) -> Tensor:
    """Return the probability that, up to a step, the model is wrong about a termination or a reward edge, (b, T).

    If termination is declared and no sample has ended, it is 1 from the step at which a path ends.
    """
    q, q_next = paths.q.flatten(0, 1), paths.q_next.flatten(0, 1)
    doubt = in_doubt(model, q_next).maximum(edge_in_doubt(model, q, q_next)).reshape(paths.running.shape)
    wrong = (doubt * paths.running).cummax(1).values
    return wrong if aim.ended or model.definition.learns_termination else wrong.maximum(paths.ended)


def _weights(definition: EnvironmentDefinition, aim: Aim, paths: Paths) -> Tensor:
    """Return the weight of each step of each path in the value of a plan, (b, T).

    With snapshots the weight also contains the sampling density at the state. Otherwise plans could lead ever farther
    away, to states that hardly matter for the verdict.
    """
    weight = paths.running * definition.in_range(paths.q) * definition.known(paths.q) * (-0.5 * paths.drift).exp()
    if aim.snapshots:
        columns = zip(definition.coordinates, paths.q.unbind(-1), strict=True)
        weight = weight * (0.5 * torch.stack([c.sampling.log_density(q) for c, q in columns]).sum(0)).exp()
    if aim.states is None or not len(aim.states):
        return weight
    density = log_occupancy(definition, aim.states, paths.q.flatten(0, 1)).exp().reshape(weight.shape)
    return weight * (density / density.max()).sqrt()


def vary(definition: EnvironmentDefinition, sequences: Sequences, rng: np.random.Generator) -> None:
    """Change each sequence (k, T, F) in place: a random stretch of it gets a new constant action."""
    for sequence in sequences:
        first, last = sorted(rng.integers(sequence.shape[0] + 1, size=2))
        sequence[first : last + 1] = _random_actions(definition, 1, rng)


def _random_actions(definition: EnvironmentDefinition, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw random actions (count, F). Half of the continuous entries are at a limit, because such actions reach
    farthest."""
    action = definition.action
    if action.nvec:
        return rng.integers(action.nvec, size=(count, action.size)).astype(np.float64)
    low, high = action.limits
    p = rng.random((count, action.size))
    extreme = rng.random((count, action.size)) < 0.5
    return np.asarray(low + (high - low) * np.where(extreme, p.round(), p))
