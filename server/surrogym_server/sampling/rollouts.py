"""Action sequences for an environment that can't be set to any state: first random, then planned in the model.

A sequence begins at a reset, or at a snapshot: a state to which the environment can return.

The value of a sequence is the acquisition's value per real step: for most acquisitions, the information that the
predicted path gives about the outputs (``PathOutlook.information``). A step has weight 0 outside the sampling range and
after the end of an episode. The weight falls with the variance accumulated along the path, so a sequence ends where its
path can't be predicted.
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
from surrogym_server.environment.distributions import log_density, quantile, scaling
from surrogym_server.models.abilities import PathOutlook, PredictedSteps
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.acquisition import PathView, path_value_of
from surrogym_server.sampling.endings import edge_in_doubt, in_doubt
from surrogym_server.sampling.lookahead import as_if_answered, path_outlook
from surrogym_server.sampling.occupancy import log_occupancy
from surrogym_shared.nouns import Query, Vector

STARTS = 6  # the path of an action sequence after a reset is predicted from this many random start states
POPULATION = 48  # number of action sequences that are compared at once
ELITE = 12  # number of the best sequences that remain, together with variations of them, in the next population
GENERATIONS = 3  # number of populations in a search, the random first one included
# A sequence is planned to find an unknown termination or jump of the reward only if some sequence finds it with more
# than this probability. Otherwise sequences are planned for the acquisition's value.
DOUBTFUL = 0.25

Sequences = NDArray[np.float64]  # k sequences of T actions with F entries, (k, T, F)
# Function that rates k action sequences, each from s equally likely start states (k, s, C). It may cut each sequence
# off. It returns the value of each sequence, and the number of its actions that remain, (k,) each.
Worth = Callable[[Tensor, Sequences], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Aim:
    """Objective of a planned action sequence (about which outputs it should give information), and restrictions on the
    sequence."""

    columns: Sequence[int]  # indices of the outputs about which the sequence should give information
    tolerances: Sequence[float]  # (O,) tolerance of every output, in its unit
    longest: int  # greatest number of actions in the sequence
    snapshots: Mapping[str, Vector] = field(default_factory=dict)  # states at which a sequence may begin, by name
    states: Tensor | None = None  # (v, C) states that policies visited; steps count more where these are dense
    ending: bool = False  # whether to prefer sequences that may show an unknown termination or jump of the reward
    ended: bool = False  # whether a sample has ended an episode; if so, a declared termination need not be searched for
    tried: Sequences | None = None  # (k, T, F) sequences after a reset that a search tries beside random ones


@dataclass(frozen=True)
class Paths:
    """b predicted paths of T steps each, in which every step has the mean result."""

    q: Tensor  # (b, T, C) states before each step
    u: Tensor  # (b, T, F) actions
    q_next: Tensor  # (b, T, C) states after each step
    running: Tensor  # (b, T) 1 for steps of a running episode; 0 after it ended or came too close to a declared limit
    ended: Tensor  # (b, T) 1 from the step that ends the episode, 0 before
    # (b, T) predictive variances of the moving coordinates, summed over coordinates and earlier steps, each divided by
    # the variance of the coordinate's sampling range.
    drift: Tensor


def first_rollouts(definition: EnvironmentDefinition, steps: int, rng: np.random.Generator) -> tuple[Query, ...]:
    """Draw random action sequences (rollouts) of 1, 2, 3, ... actions, until they have ``steps`` actions in total.

    A sequence repeats each action for a random number of steps, so that the states spread. If coordinates repeat past
    values (lags), each sequence is longer by the number of first steps at which these values are not known yet.
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
    """Plan action sequences (rollouts) with ``steps`` real steps in total, for the objective ``aim``.

    Each sequence is planned as if the sequences planned before and the unanswered queries had been answered, with the
    results that the model predicts. For a model without the ability ``Lookahead`` they make no difference.
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
    """Plan the action sequence with the highest value per expected real step, from a reset or from a snapshot.

    The search first compares random sequences and those of ``aim.tried``, then variations of the best ones.
    """
    return best_rollout(model.definition, partial(_worth, model, aim), aim.longest, aim.snapshots, rng, aim.tried)


def best_rollout(
    definition: EnvironmentDefinition,
    worth: Worth,
    longest: int,
    snapshots: Mapping[str, Vector],
    rng: np.random.Generator,
    tried: Sequences | None = None,
) -> Query:
    """Search for the sequence of at most ``longest`` actions that has the highest value by the function ``worth``. It
    begins at a reset or at one of the ``snapshots``. Sequences after a reset to begin the search with, ``tried``, have
    ``longest`` actions or more."""
    starts = start_points(definition, STARTS, rng)[None]
    actions, _, value = _search(definition, worth, longest, starts, POPULATION, rng, tried)
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
    tried: Sequences | None = None,
) -> tuple[NDArray[np.float64], int, float]:
    """Search for the sequence of actions (T, F) with the highest value by the function ``worth``, from any of k
    origins. Each origin consists of s equally likely states; ``origins`` is (k, s, C).

    ``longest`` is the greatest number of actions, and ``population`` the number of sequences that are compared at once.
    ``tried`` (b, longest or more, F) take the place of at most half of the first random sequences. Return the sequence,
    the index of its origin, and its value.
    """
    sequences = random_sequences(definition, population, longest, rng)
    if tried is not None:
        first = tried[: population // 2, :longest]
        sequences[: len(first)] = first
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
    """Return the model as if the action sequence ``query`` had been carried out with the predicted results: variances
    decrease, means stay.

    If the query's snapshot is not among ``snapshots``, the path begins at a reset.
    """
    start = start_points(model.definition, 1, rng)
    if (at := snapshots.get(query.snapshot or "")) is not None:
        start = torch.tensor([at], dtype=torch.float64)
    path = predict_paths(model, start, torch.tensor([query.actions], dtype=torch.float64))
    learnable = (path.running[0] > 0) & model.definition.known(path.q[0])
    return as_if_answered(model, PredictedSteps(path.q[0, learnable], path.u[0, learnable], path.q_next[0, learnable]))


def start_points(definition: EnvironmentDefinition, count: int, rng: np.random.Generator) -> Tensor:
    """Draw states after a reset, (count, C), from the declared start distribution. Each coordinate is stratified: it
    has one value in each of ``count`` intervals of equal probability."""
    columns = [
        quantile(start, torch.from_numpy((rng.permutation(count) + rng.random(count)) / count))
        for start in definition.start
    ]
    if definition.counter is not None:
        columns[definition.counter] = torch.zeros(count, dtype=torch.float64)
    return torch.stack(columns, -1)


def random_sequences(definition: EnvironmentDefinition, count: int, length: int, rng: np.random.Generator) -> Sequences:
    """Draw random action sequences (count, length, F). Each sequence repeats every action for 1, 2, 4, ... steps; this
    number is drawn once for a sequence."""
    times = 2 ** np.arange(int(np.log2(length)) + 1)
    sequences = np.empty((count, length, definition.action.size))
    for sequence in sequences:
        hold = int(rng.choice(times))
        values = _random_actions(definition, -(-length // hold), rng)
        sequence[:] = np.repeat(values, hold, axis=0)[:length]
    return sequences


def predict_paths(model: DynamicsModel, starts: Tensor, actions: Tensor) -> Paths:
    """Predict a path from each of b starts (b, C) under its sequence of T actions (b, T, F), with the mean result of
    every step."""
    definition = model.definition
    spread = starts.new_tensor([scaling(definition.coordinates[i].sampling)[1] for i in definition.moving])
    q, running, going = starts, starts.new_ones(len(starts)), starts.new_ones(len(starts))
    drift, variance = starts.new_zeros(len(starts)), starts.new_zeros(len(starts), len(spread))
    steps: list[tuple[Tensor, ...]] = []
    for asked in actions.unbind(1):
        u = definition.within_rates(q, asked)
        step = model.transition(q, u, stds=True)
        assert step.std is not None
        going = going * ~model.terminated(step.q_next)
        steps.append((q, u, step.q_next, running, 1 - going, drift))
        drift, variance = drift + (step.std / spread).square().sum(-1), variance + step.std.square()
        running = running * going * ~_may_leave_limits(definition, q, step.q_next, variance)
        q = step.q_next
    return Paths(*(torch.stack(column, 1) for column in zip(*steps, strict=True)))


def _may_leave_limits(definition: EnvironmentDefinition, q: Tensor, q_next: Tensor, variance: Tensor) -> Tensor:
    """Return (b,) bool: which of b paths come too close to a declared limit in a step from q (b, C) to q_next (b, C).
    It is too close if the step ends within the limit's margin, where the sampler switches to its fallback action, or if
    the probability of being outside the limit is above the declared one.

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
    """Return the acquisition's value of the first 1, 2, ... T steps of each path, (b, T), summed over the outputs in
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
    """Return the values from which an acquisition rates paths with respect to one output, such as its standard
    deviations along them. ``weight`` (b, T) is the weight of each step, ``tolerance`` that of the output."""
    return PathView(tolerance, weight, lambda: output.std, lambda: output.information(weight, tolerance))


def _worth(model: DynamicsModel, aim: Aim, starts: Tensor, sequences: Sequences) -> tuple[Tensor, Tensor]:
    """Rate k action sequences (k, T, F). Each is cut off after the number of actions that gives the highest value per
    expected real step. ``starts`` (k, s, C) are s equally likely first states of each sequence.

    Return the highest value per expected real step (k,), and the number of actions (k,) that gives it.
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
    """Return for each step of each path the largest probability, up to this step, that the model is wrong about a
    termination or about a jump of the reward, (b, T).

    If termination is declared and no sample has ended an episode, the result is 1 from the step that ends the episode.
    """
    q, q_next = paths.q.flatten(0, 1), paths.q_next.flatten(0, 1)
    doubt = in_doubt(model, q_next).maximum(edge_in_doubt(model, q, q_next)).reshape(paths.running.shape)
    wrong = (doubt * paths.running).cummax(1).values
    if aim.ended or model.definition.learns_termination:
        return wrong
    return wrong.maximum(paths.ended)


def predictability(paths: Paths) -> Tensor:
    """Return how well each step of each path can be predicted, (b, T): 1 at the start, less the more variance its
    earlier steps add up to."""
    return (-0.5 * paths.drift).exp()


def _weights(definition: EnvironmentDefinition, aim: Aim, paths: Paths) -> Tensor:
    """Return the weight with which each step of each path counts in the value of a planned sequence, (b, T).

    If sequences may begin at snapshots, the weight also has the square root of the sampling density at the state as a
    factor. Otherwise sequences could lead farther and farther away, to states that hardly matter for the confidence.
    """
    weight = paths.running * definition.in_range(paths.q) * definition.known(paths.q) * predictability(paths)
    if aim.snapshots:
        columns = zip(definition.coordinates, paths.q.unbind(-1), strict=True)
        weight = weight * (0.5 * torch.stack([log_density(c.sampling, q) for c, q in columns]).sum(0)).exp()
    if aim.states is None or not len(aim.states):
        return weight
    density = log_occupancy(definition, aim.states, paths.q.flatten(0, 1)).exp().reshape(weight.shape)
    return weight * (density / density.max()).sqrt()


def vary(definition: EnvironmentDefinition, sequences: Sequences, rng: np.random.Generator) -> None:
    """Vary each of k action sequences (k, T, F) in place: a random interval of its steps gets a new constant action."""
    for sequence in sequences:
        first, last = sorted(rng.integers(sequence.shape[0] + 1, size=2))
        sequence[first : last + 1] = _random_actions(definition, 1, rng)


def _random_actions(definition: EnvironmentDefinition, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw random actions (count, F). Half of the continuous entries are at the lower or upper limit, because such
    actions lead farthest."""
    action = definition.action
    if action.nvec:
        return rng.integers(action.nvec, size=(count, action.size)).astype(np.float64)
    low, high = definition.action_limits
    p = rng.random((count, action.size))
    extreme = rng.random((count, action.size)) < 0.5
    return np.asarray(low + (high - low) * np.where(extreme, p.round(), p))
