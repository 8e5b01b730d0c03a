"""Compiled code that predicts a step of many lanes (parallel environments): next coordinates, rewards, terminations."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from numba import types
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.compiled.tables import Tables, TablesBuilder, matrix
from surrogym_server.compiled.threads import side_by_side
from surrogym_server.environment.compiled.features import add_features, encode
from surrogym_server.environment.compiled.reward import add_declared, add_reward
from surrogym_server.environment.compiled.rules import add_inverse, add_rules, clipped, recover, repeat, settle
from surrogym_server.environment.compiled.terms import add_conditions, add_terms, evaluate, holding
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import leading
from surrogym_server.gp.compiled import add_process, predict
from surrogym_server.models.abilities import ArraySteps, ArrayTransition
from surrogym_server.models.gaussian_process.prediction.compiled.layout import (
    AFTER_FEATURES,
    AFTER_WIDTH,
    BLOCK,
    CONDITIONS,
    DECLARED,
    ENDING,
    ENTRIES,
    FEATURES,
    HAS_STAGE,
    HEAD,
    INVERSE,
    JUMPS,
    LEAD,
    LEADS,
    LED_WIDTH,
    MOVES_OBSERVATION,
    NONE,
    OBSERVE,
    OUTPUTS,
    PROCESSES,
    READS_AFTER,
    RULES,
    WARP,
    WIDTH,
)
from surrogym_server.models.gaussian_process.prediction.predictor import Predictor
from surrogym_server.models.gaussian_process.prediction.regions import Region
from surrogym_server.models.gaussian_process.prediction.warp import LARGEST
from surrogym_shared.compiled.jit import entry, inlined

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

# The matrix of outputs has a row for each output. Its columns: value of an output that never varied, standard deviation
# of the learned noise, and stage of the prediction.
CENTRE, NOISE, STAGE = range(3)
# A prediction has three stages: first outputs that read only coordinates and action, then outputs that also read the
# predicted next values of leading coordinates, last a reward that reads the predicted next state.
FIRST, LED, AFTER = range(3)
STAGES = 3


def tables_of(predictor: Predictor, ending: Region | None) -> Tables:
    """Build the tables of numbers in which the compiled function ``step`` finds a model and its environment.

    ``ending`` is the region in which episodes end, or None if termination is declared.
    """
    definition, tables = predictor.definition, TablesBuilder()
    place = tables.reserve()
    head = dict.fromkeys(range(ENTRIES), float(NONE))
    first, second, after = predictor._groups
    head[OBSERVE] = add_terms(tables, definition.observe)
    head[FEATURES] = add_features(tables, definition, first.encoder)
    head[WIDTH], head[LED_WIDTH] = first.encoder.width(lead=False), first.encoder.width(lead=second is not None)
    head[AFTER_WIDTH] = 0
    if after is not None:
        head[AFTER_FEATURES] = add_features(tables, definition, after.encoder)
        head[AFTER_WIDTH] = after.encoder.width(lead=False)
    head[OUTPUTS], head[PROCESSES] = _add_outputs(tables, predictor)
    lead = leading(definition) if second is not None else ()
    head[LEAD], head[LEADS] = tables.add(lead), len(lead)
    for stage, group in enumerate((first, second, after)):
        head[HAS_STAGE + stage] = group is not None
    head[RULES] = add_rules(tables, definition)
    head[INVERSE] = add_inverse(tables, predictor._inverse)
    head[MOVES_OBSERVATION] = definition.moves_observation
    head[READS_AFTER] = predictor.reward.feature_map.after
    if (warp := predictor.reward.warp) is not None:
        head[WARP] = tables.add([[warp.base, warp.sign]])
    if definition.declared_reward is not None:
        head[DECLARED] = add_reward(tables, definition.declared_reward)
    if definition.termination_groups:
        head[CONDITIONS] = add_conditions(tables, definition._termination)
    if ending is not None or predictor.jumps:
        from surrogym_server.models.gaussian_process.prediction.compiled.regions import add_jumps, add_region

        head[JUMPS] = add_jumps(tables, predictor.jumps)
        head[ENDING] = NONE if ending is None else add_region(tables, ending)
    tables.fill(place, [head[i] for i in range(ENTRIES)])
    return tables.build()


def _add_outputs(tables: TablesBuilder, predictor: Predictor) -> tuple[int, int]:
    """Add to the tables a matrix with a row for each output, and a matrix with a row for the process of each output
    that varies. Return the indices of the two matrices."""
    rows, processes = np.zeros((predictor._reward_column + 1, 3)), []
    begins = {one.column: one.span.start for group in predictor._groups if group for one in group.drawn}
    places = (*predictor._columns, predictor._reward_column)
    for number, output in enumerate((*predictor.transitions, predictor.reward)):
        stage = 2 if output.feature_map.after else int(output.feature_map.lead)
        group = predictor._groups[2 if stage == 2 else 0]
        assert group is not None
        column, posterior = places[number], output.posterior
        if posterior is None:
            rows[column] = output.centre, 0.0, stage
            continue
        rows[column] = 0.0, output.scale * math.sqrt(posterior.hyper.noise_variance), stage
        inputs = group.encoder.inputs(output.feature_map)
        place = add_process(tables, posterior, inputs, output.centre, output.scale)
        rates = output.feature_map.rates
        grown = tables.add([inputs, rates], [output.centre]) if rates else NONE
        processes.append((stage, column, number, place, begins[column], grown))
    return tables.add(rows), tables.add(np.array(processes).reshape(-1, 6))


@inlined
def _encode_stage(
    numbers: Floats, places: Ints, head: Floats, stage: int, raw: Floats, arrived: Floats, mean: Floats, x: Floats
) -> None:
    """Compute the features of B lanes (parallel environments) that outputs of a stage read and that no earlier stage
    has computed, and write them to x (d, B).

    They are computed from ``raw`` (C + F + L, B): C coordinates and F action entries, which the first stage reads, and
    the predicted next values of L leading coordinates, which the second stage first writes and then reads. The third
    stage replaces the coordinates by the next coordinates ``arrived`` (C, B). ``head`` is the first matrix of the
    tables ``numbers`` and ``places``, and ``mean`` (columns, B) has the changes that earlier stages predicted.
    """
    size, lanes, observe = len(arrived), raw.shape[1], int(head[0, OBSERVE])
    width, begin, end = int(head[0, WIDTH]), 0, int(head[0, WIDTH])
    features = int(head[0, AFTER_FEATURES if stage == AFTER else FEATURES])
    if stage == LED:
        lead, rules = matrix(numbers, places, int(head[0, LEAD])), matrix(numbers, places, int(head[0, RULES]))
        first, begin, end = len(raw) - lead.shape[1], width, int(head[0, LED_WIDTH])
        for i in range(lead.shape[1]):
            c = int(lead[0, i])
            for b in range(lanes):
                raw[first + i, b] = clipped(rules, c, raw[c, b] + mean[c, b])
    elif stage == AFTER:
        end = int(head[0, AFTER_WIDTH])
        for c in range(size):
            for b in range(lanes):
                raw[c, b] = arrived[c, b]
    encode(numbers, places, features, observe, raw, size, x, begin, end)


@inlined
def _grow(numbers: Floats, places: Ints, at: int, x: Floats, mean: Floats, spread: Floats) -> None:
    """Multiply the distance of an output's ``mean`` (B,) from its centre, and its standard deviation ``spread`` (B,),
    by the output's amplitude at inputs x (d, B). ``at`` is the index, in the tables, of the output's rates (see
    ``gp.growth``), which give the amplitude."""
    rates, centre = matrix(numbers, places, at), matrix(numbers, places, at + 1)[0, 0]
    for b in range(len(mean)):
        amplitude = 1.0
        for j in range(rates.shape[1]):
            amplitude *= 1.0 + rates[1, j] * x[int(rates[0, j]), b]
        mean[b] = centre + amplitude * (mean[b] - centre)
        spread[b] *= amplitude


@inlined
def _predict_stage(
    numbers: Floats,
    places: Ints,
    head: Floats,
    stage: int,
    x: Floats,
    noise: Floats,
    process: Floats,
    paths: Floats,
    known: Floats,
    stds: bool,
    reward_std: bool,
    mean: Floats,
    spread: Floats,
) -> None:
    """Predict the outputs of one stage for B lanes (parallel environments), and write the results to ``mean`` and
    ``spread``.

    Args:
        numbers, places: tables of the model, see ``tables_of``.
        head: first matrix of the tables.
        stage: FIRST for outputs that read only coordinates and action, LED for outputs that also read the next values
            of leading coordinates, AFTER for a reward that reads the next state.
        x: features (d, B).
        noise, process, paths, known: random numbers, weights of sampled functions, and predictions of a prior model for
            these lanes; see ``step``.
        stds, reward_std: whether standard deviations of transition outputs and of the reward are needed.
        mean: (columns, B) predicted values, with a row for each coordinate or observation entry and one for the reward.
            The rows of this stage's outputs are written.
        spread: (O, B) standard deviations. The rows of this stage's outputs are written.
    """
    columns = matrix(numbers, places, int(head[0, OUTPUTS]))
    for column in range(len(columns)):
        if columns[column, STAGE] == stage:
            mean[column, :] = columns[column, CENTRE]
    processes = matrix(numbers, places, int(head[0, PROCESSES]))
    last = len(spread) - 1
    for p in range(len(processes)):
        if processes[p, 0] != stage:
            continue
        column, number = int(processes[p, 1]), int(processes[p, 2])
        wanted = reward_std if number == last else stds or len(noise) > 0
        drawn = paths[:, int(processes[p, 4]) :]
        predict(numbers, places, int(processes[p, 3]), x, wanted, drawn, mean[column], spread[number])
        if number < last and len(noise):
            for b in range(x.shape[1]):
                mean[column, b] += spread[number, b] * noise[b, number]
        if number < last and len(process):
            for b in range(x.shape[1]):
                mean[column, b] += columns[column, NOISE] * process[b, number]
        if processes[p, 5] != NONE:
            _grow(numbers, places, int(processes[p, 5]), x, mean[column], spread[number])
    if len(known):
        for column in range(len(columns)):
            if columns[column, STAGE] == stage:
                for b in range(x.shape[1]):
                    mean[column, b] += known[b, column]


@inlined
def _arrive(numbers: Floats, places: Ints, head: Floats, raw: Floats, mean: Floats, arrived: Floats) -> None:
    """Compute the next coordinates, and write them to ``arrived`` (C, B): the coordinates in the first C rows of
    ``raw``, changed by the predicted changes ``mean`` (columns, B) of coordinates or observation entries, with the
    environment's rules (such as limits) applied. ``head`` is the first matrix of the tables ``numbers`` and
    ``places``."""
    size, lanes = arrived.shape
    for c in range(size):
        for b in range(lanes):
            arrived[c, b] = raw[c, b]
    if head[0, MOVES_OBSERVATION]:
        observation = evaluate(numbers, places, int(head[0, OBSERVE]), arrived)
        for d in range(len(observation)):
            for b in range(lanes):
                observation[d, b] += mean[d, b]
        recover(numbers, places, int(head[0, INVERSE]), observation, arrived)
    else:
        for c in range(size):
            for b in range(lanes):
                arrived[c, b] += mean[c, b]
    rules = matrix(numbers, places, int(head[0, RULES]))
    settle(rules, arrived)
    repeat(rules, raw, arrived)


@inlined
def _unwarp(warp: Floats, mean: Floats, spread: Floats) -> None:
    """Convert mean and standard deviation, (B,) each, of the logarithm of a reward to those of the reward, in place.
    ``warp`` (1, 2) has the base and the sign of ``Warp``, which does the same in torch."""
    for b in range(len(mean)):
        y, s = mean[b], spread[b]
        spread[b] = 0.5 * (math.exp(min(y + s, LARGEST)) - math.exp(min(y - s, LARGEST)))
        mean[b] = warp[0, 0] + warp[0, 1] * math.exp(min(y, LARGEST))


@inlined
def _ended(numbers: Floats, places: Ints, head: Floats, arrived: Floats) -> Bools:
    """Return (B,) bool: whether the declared termination holds at coordinates ``arrived`` (C, B). ``head`` is the first
    matrix of the tables ``numbers`` and ``places``."""
    over = np.zeros(arrived.shape[1], dtype=np.bool_)
    if head[0, CONDITIONS] != NONE:
        holds = holding(numbers, places, int(head[0, CONDITIONS]), arrived)
        for g in range(len(holds)):
            for b in range(len(over)):
                over[b] |= holds[g, b]
    return over


@entry(
    types.float64[::1],
    types.int64[:, ::1],
    types.float64[:, ::1],
    types.float64[:, ::1],
    types.float64[:, ::1],
    types.float64[:, ::1],
    types.float64[:, ::1],
    types.float64[:, ::1],
    types.boolean,
    types.boolean,
    types.float64[:, ::1],
    types.float64[::1],
    types.float64[:, ::1],
    types.boolean[::1],
    types.float64[:, ::1],
)
def step(
    numbers: Floats,
    places: Ints,
    q: Floats,
    u: Floats,
    noise: Floats,
    process: Floats,
    paths: Floats,
    known: Floats,
    stds: bool,
    reward_std: bool,
    q_next: Floats,
    reward: Floats,
    std: Floats,
    terminated: Bools,
    change: Floats,
) -> None:
    """Compute N steps, and write the results to the last five arrays.

    Args:
        numbers, places: tables of the model, see ``tables_of``.
        q: coordinates (N, C).
        u: actions (N, F).
        noise: (N, M) numbers of standard deviations to add to the mean of each transition output, or (0, 0).
        process: (N, M) standard normal numbers, by which the learned noise moves each transition output, or (0, 0) for
            no noise.
        paths: (N, W) weights of the sampled function that each row follows, or (0, 0) for the mean.
        known: (N, columns) predictions of a prior model to add to the outputs, or (0, 0). There is a column for each
            coordinate or observation entry, and one for the reward.
        stds, reward_std: whether standard deviations of transition outputs and of the reward are needed.
        q_next: next coordinates (N, C).
        reward: (N,) rewards, without the terminal reward.
        std: (N, O) standard deviations, where needed.
        terminated: (N,) whether the declared termination holds.
        change: (N, columns) predicted changes before limits are applied, or (0, 0) if they are not needed.
    """
    head, size, actions = matrix(numbers, places, HEAD), q.shape[1], u.shape[1]
    columns, leads = len(matrix(numbers, places, int(head[0, OUTPUTS]))), int(head[0, LEADS])
    width = int(max(head[0, LED_WIDTH], head[0, AFTER_WIDTH]))
    for begin in range(0, len(q), BLOCK):
        lanes = min(BLOCK, len(q) - begin)
        raw, arrived = np.empty((size + actions + leads, lanes)), np.empty((size, lanes))
        for b in range(lanes):
            for c in range(size):
                raw[c, b] = q[begin + b, c]
            for f in range(actions):
                raw[size + f, b] = u[begin + b, f]
        mean, spread = np.zeros((columns, lanes)), np.zeros((std.shape[1], lanes))
        x, end = np.empty((width, lanes)), begin + lanes
        kick, shake, drawn, added = noise[begin:end], process[begin:end], paths[begin:end], known[begin:end]
        for stage in range(STAGES):
            if stage == AFTER:
                _arrive(numbers, places, head, raw, mean, arrived)
            if head[0, HAS_STAGE + stage]:
                _encode_stage(numbers, places, head, stage, raw, arrived, mean, x)
                _predict_stage(
                    numbers,
                    places,
                    head,
                    stage,
                    x,
                    kick,
                    shake,
                    drawn,
                    added,
                    stds,
                    reward_std,
                    mean,
                    spread,
                )
        if head[0, WARP] != NONE:
            _unwarp(matrix(numbers, places, int(head[0, WARP])), mean[columns - 1], spread[len(spread) - 1])
        if head[0, DECLARED] != NONE:
            state, pushed = raw[:size], raw[size : size + actions]
            add_declared(numbers, places, int(head[0, DECLARED]), state, pushed, mean[columns - 1])
        over = _ended(numbers, places, head, arrived)
        for b in range(lanes):
            for c in range(size):
                q_next[begin + b, c] = arrived[c, b]
            for o in range(len(spread)):
                std[begin + b, o] = spread[o, b]
            reward[begin + b], terminated[begin + b] = mean[columns - 1, b], over[b]
        if len(change):
            for b in range(lanes):
                for c in range(columns):
                    change[begin + b, c] = mean[c, b]


NO_ROWS = np.zeros((0, 0))
# A call that computes at least this many covariances takes some milliseconds, so it uses several threads.
SPLIT = 4_000_000


@dataclass(frozen=True, eq=False)
class StepsOfModel(ArraySteps):
    """Callable object that predicts steps of one model by compiled code."""

    definition: EnvironmentDefinition
    tables: Tables
    outputs: int
    has_regions: bool  # whether the model has a learned termination or learned jumps of the reward
    points: int  # number of training points of all Gaussian processes, with the mirrored copies that a symmetry adds
    prior: StepsOfModel | None  # compiled steps of the prior model, whose predictions are added where ``uses`` is 1
    # (columns,) for each coordinate or observation entry, and last the reward: 1 if the prior model's prediction is
    # added to it, otherwise 0.
    uses: Floats
    doubted: Floats  # (O,) for each output, see ``Predictor.doubted``
    output_of_weight: Ints  # (W,) for each weight of a sampled function, see ``Predictor.output_of_weight``
    growth: Callable[[Tensor, Tensor], Tensor]  # see ``Predictor.growth``

    @classmethod
    def of(cls, predictor: Predictor, ending: Region | None, prior: StepsOfModel | None) -> Self:
        """Prepare a model for compiled code.

        Args:
            predictor: predictor of the model's outputs.
            ending: region in which episodes end, or None if termination is declared.
            prior: compiled steps of the model's prior, or None.
        """
        regions = ending is not None or bool(predictor.jumps)
        points = sum(group.serving.exponents.shape[1] for group in predictor._groups if group)
        outputs, tables = len(predictor.transitions) + 1, tables_of(predictor, ending)
        arrays = (predictor.uses_prior, predictor.doubted, predictor.output_of_weight)
        uses, doubted, owners = (array.cpu().numpy() for array in arrays)
        return cls(
            predictor.definition, tables, outputs, regions, points, prior, uses, doubted, owners, predictor.growth
        )

    def __call__(
        self,
        q: Floats,
        u: Floats,
        *,
        noise: Floats | None,
        process: Floats | None,
        paths: Floats | None,
        stds: bool,
        reward_std: bool,
    ) -> ArrayTransition:
        return self._steps(q, u, noise, process, paths, stds, reward_std, NO_ROWS)

    def _by_prior(self, prior: StepsOfModel, q: Floats, u: Floats) -> Floats:
        """Return the prior model's predictions (N, columns) at q (N, C) and u (N, F): a column for each coordinate or
        observation entry, and one for the reward. Columns of outputs that don't use the prior model are 0."""
        added = np.empty((len(q), len(self.uses)))
        added[:, -1] = prior._steps(q, u, None, None, None, False, False, added).reward
        return added * self.uses

    def _steps(  # it has many parameters, because the compiled function ``step`` takes arrays one by one
        self,
        q: Floats,
        u: Floats,
        noise: Floats | None,
        process: Floats | None,
        paths: Floats | None,
        stds: bool,
        reward_std: bool,
        change: Floats,
    ) -> ArrayTransition:
        """Predict as ``__call__`` does. If ``change`` (N, columns) has rows, also write the predicted changes to it, as
        they are before limits are applied."""
        count = len(q)
        moved = ArrayTransition(
            np.empty_like(q), np.empty(count), np.empty((count, self.outputs)), np.empty(count, dtype=np.bool_)
        )
        noise, process, paths = (NO_ROWS if given is None else given for given in (noise, process, paths))
        known = NO_ROWS if self.prior is None else self._by_prior(self.prior, q, u)
        doubt: Floats | None = None
        if self.prior is not None and (stds or reward_std or len(noise) or len(paths)):
            sigma = self.prior._steps(q, u, None, None, None, True, True, NO_ROWS).std
            sigma = sigma / self.growth(torch.from_numpy(q), torch.from_numpy(u)).numpy()
            doubt = np.sqrt(1 + sigma**2 / self.doubted)  # see ``Predictor._doubt``
            noise = noise * doubt[:, :-1] if len(noise) else noise
            weights = self.output_of_weight
            paths = paths[:, : len(weights)] * doubt[:, weights] if len(paths) else paths

        def rows(at: slice) -> None:
            step(
                *self.tables,
                q[at],
                u[at],
                noise[at],
                process[at],
                paths[at],
                known[at],
                stds,
                reward_std,
                moved.q_next[at],
                moved.reward[at],
                moved.std[at],
                moved.terminated[at],
                change[at],
            )

        if count * self.points < SPLIT:
            rows(slice(None))
        else:
            side_by_side(rows, count, BLOCK, torch.get_num_threads())
        if self.has_regions:
            from surrogym_server.models.gaussian_process.prediction.compiled.regions import judge

            judge(
                *self.tables,
                q,
                moved.q_next,
                u.shape[1],
                reward_std,
                moved.reward,
                moved.std,
                moved.terminated,
            )
        if doubt is not None:
            moved.std[:] *= doubt
        return moved
