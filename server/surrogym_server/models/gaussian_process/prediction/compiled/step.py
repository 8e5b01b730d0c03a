"""The step of a block of lanes, from coordinates and actions to next coordinates, rewards and ends."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numba import types
from numpy.typing import NDArray

from surrogym_server.compiled.jit import compiled, entry, inlined
from surrogym_server.compiled.tables import Tables, TablesBuilder, matrix
from surrogym_server.environment.compiled.features import add_features, encode
from surrogym_server.environment.compiled.reward import add_declared, add_reward
from surrogym_server.environment.compiled.rules import add_inverse, add_rules, clipped, recover, settle
from surrogym_server.environment.compiled.terms import add_conditions, add_terms, evaluate, holding
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import leading
from surrogym_server.gp.compiled import add_process, predict
from surrogym_server.models.abilities import ArraySteps, ArrayTransition
from surrogym_server.models.gaussian_process.prediction.compiled.regions import (
    add_jumped,
    add_jumps,
    add_region,
    probability,
)
from surrogym_server.models.gaussian_process.prediction.predictor import Predictor
from surrogym_server.models.gaussian_process.prediction.regions import Region

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

BLOCK = 32  # lanes computed at once: what is held of them stays in the first cache

# Numbers of the head, and places of what is read: all in the matrix HEAD.
HEAD = 0
(
    OBSERVE,
    FEATURES,
    WIDTH,
    LED_WIDTH,
    AFTER_FEATURES,
    AFTER_WIDTH,
    OUTPUTS,
    PROCESSES,
    LEAD,
    RULES,
    INVERSE,
    MOVES_OBSERVATION,
    READS_AFTER,
    DECLARED,
    JUMPS,
    CONDITIONS,
    ENDING,
) = range(17)
CENTRE, NOISE, STAGE = range(3)  # of each column of outputs: constant, deviation of its noise, and when it is predicted
NONE = -1


def tables_of(predictor: Predictor, ending: Region | None) -> Tables:
    """All that ``step`` reads of a model and its environment."""
    definition, tables = predictor.definition, TablesBuilder()
    place = tables.reserve()
    head = dict.fromkeys(range(17), float(NONE))
    first, second, after = predictor._groups
    head[OBSERVE] = add_terms(tables, definition.observe)
    head[FEATURES] = add_features(tables, definition, first.encoder)
    head[WIDTH], head[LED_WIDTH] = first.encoder.width(lead=False), first.encoder.width(lead=second is not None)
    head[AFTER_WIDTH] = 0
    if after is not None:
        head[AFTER_FEATURES] = add_features(tables, definition, after.encoder)
        head[AFTER_WIDTH] = after.encoder.width(lead=False)
    head[OUTPUTS], head[PROCESSES] = _add_outputs(tables, predictor)
    head[LEAD] = tables.add(leading(definition) if second is not None else ())
    head[RULES] = add_rules(tables, definition)
    head[INVERSE] = add_inverse(tables, predictor._inverse)
    head[MOVES_OBSERVATION] = definition.moves_observation
    head[READS_AFTER] = predictor.reward.feature_map.after
    if definition.declared_reward is not None:
        head[DECLARED] = add_reward(tables, definition.declared_reward)
    head[JUMPS] = add_jumps(tables, predictor.jumps)
    if ending is not None:
        head[ENDING] = add_region(tables, ending)
    elif definition.termination_groups:
        head[CONDITIONS] = add_conditions(tables, definition._termination)
    tables.fill(place, [head[i] for i in range(17)])
    return tables.build()


def _add_outputs(tables: TablesBuilder, predictor: Predictor) -> tuple[int, int]:
    """Put columns of outputs, and processes by stage; gives their places."""
    rows, processes = np.zeros((predictor._reward_column + 1, 3)), []
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
        processes.append((stage, column, number, place))
    return tables.add(rows), tables.add(np.array(processes).reshape(-1, 4))


@inlined
def _predict_changes(
    numbers: Floats,
    places: Ints,
    head: Floats,
    raw: Floats,
    size: int,
    process: Floats,
    deviations: bool,
    reward_deviation: bool,
    mean: Floats,
    spread: Floats,
) -> None:
    """Changes, and a reward that reads the state before, (columns, B), and deviations (O, B); the lead is put behind
    the actions of raw (C + F + L, B)."""
    features, observe = int(head[0, FEATURES]), int(head[0, OBSERVE])
    width, led_width = int(head[0, WIDTH]), int(head[0, LED_WIDTH])
    x = np.empty((led_width, raw.shape[1]))
    encode(numbers, places, features, observe, raw, size, x, 0, width)
    _predict_stage(numbers, places, head, 0, x, process, deviations, reward_deviation, mean, spread)
    if led_width == width:
        return
    lead, rules = matrix(numbers, places, int(head[0, LEAD])), matrix(numbers, places, int(head[0, RULES]))
    first = len(raw) - lead.shape[1]
    for i in range(lead.shape[1]):
        c = int(lead[0, i])
        for b in range(raw.shape[1]):
            raw[first + i, b] = clipped(rules, c, raw[c, b] + mean[c, b])
    encode(numbers, places, features, observe, raw, size, x, width, led_width)
    _predict_stage(numbers, places, head, 1, x, process, deviations, reward_deviation, mean, spread)


@compiled
def _predict_stage(
    numbers: Floats,
    places: Ints,
    head: Floats,
    stage: int,
    x: Floats,
    process: Floats,
    deviations: bool,
    reward_deviation: bool,
    mean: Floats,
    spread: Floats,
) -> None:
    """Outputs of one stage at features x (d, B)."""
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
        wanted = reward_deviation if number == last else deviations
        predict(numbers, places, int(processes[p, 3]), x, wanted, mean[column], spread[number])
        if number < last and len(process):
            for b in range(x.shape[1]):
                mean[column, b] += columns[column, NOISE] * process[b, number]


@inlined
def _arrive(numbers: Floats, places: Ints, head: Floats, q: Floats, mean: Floats) -> Floats:
    """Next coordinates of q (C, B) that change by mean (columns, B), (C, B)."""
    arrived = np.empty_like(q)
    for c in range(len(q)):
        for b in range(q.shape[1]):
            arrived[c, b] = q[c, b]
    if head[0, MOVES_OBSERVATION]:
        observation = evaluate(numbers, places, int(head[0, OBSERVE]), q)
        for d in range(len(observation)):
            for b in range(q.shape[1]):
                observation[d, b] += mean[d, b]
        recover(numbers, places, int(head[0, INVERSE]), observation, arrived)
    else:
        for c in range(len(q)):
            for b in range(q.shape[1]):
                arrived[c, b] += mean[c, b]
    settle(matrix(numbers, places, int(head[0, RULES])), arrived)
    return arrived


@inlined
def _pay(
    numbers: Floats,
    places: Ints,
    head: Floats,
    raw: Floats,
    size: int,
    actions: int,
    arrived: Floats,
    state: Floats,
    reward_deviation: bool,
    mean: Floats,
    spread: Floats,
) -> Floats:
    """Rewards (B,); their deviation in the last row of ``spread`` is widened by doubtful edges."""
    lanes = raw.shape[1]
    observe, last = int(head[0, OBSERVE]), len(mean) - 1
    none = np.empty((0, 0))
    if head[0, READS_AFTER]:
        after = np.empty((size + actions, lanes))
        for b in range(lanes):
            for c in range(size):
                after[c, b] = arrived[c, b]
            for f in range(size, size + actions):
                after[f, b] = raw[f, b]
        width = int(head[0, AFTER_WIDTH])
        x = np.empty((width, lanes))
        encode(numbers, places, int(head[0, AFTER_FEATURES]), observe, after, size, x, 0, width)
        _predict_stage(numbers, places, head, 2, x, none, False, reward_deviation, mean, spread)
    pay: Floats = mean[last]
    if head[0, DECLARED] != NONE:
        add_declared(numbers, places, int(head[0, DECLARED]), state, raw[size : size + actions], pay)
    if len(matrix(numbers, places, int(head[0, JUMPS]))):
        variance = np.zeros(lanes)
        add_jumped(numbers, places, int(head[0, JUMPS]), observe, state, actions, pay, variance)
        for b in range(lanes):
            if reward_deviation:
                spread[-1, b] = np.sqrt(spread[-1, b] * spread[-1, b] + variance[b])
    return pay


@inlined
def _ended(numbers: Floats, places: Ints, head: Floats, arrived: Floats, actions: int) -> Bools:
    """Whether episodes end at coordinates (C, B), (B,)."""
    over = np.zeros(arrived.shape[1], dtype=np.bool_)
    if head[0, ENDING] != NONE:
        inside = probability(numbers, places, int(head[0, ENDING]), int(head[0, OBSERVE]), arrived, actions)
        for b in range(len(over)):
            over[b] = inside[b] > 0.5
    elif head[0, CONDITIONS] != NONE:
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
    types.boolean,
    types.boolean,
    types.float64[:, ::1],
    types.float64[::1],
    types.float64[:, ::1],
    types.boolean[::1],
)
def step(
    numbers: Floats,
    places: Ints,
    q: Floats,
    u: Floats,
    process: Floats,
    deviations: bool,
    reward_deviation: bool,
    q_next: Floats,
    reward: Floats,
    deviation: Floats,
    terminated: Bools,
) -> None:
    """Steps from q (N, C) under u (N, F), moved by ``process`` (N, M) deviations of the noise where it has rows, into
    ``q_next`` (N, C), ``reward`` (N,), ``deviation`` (N, O) of what is asked for, and ``terminated`` (N,)."""
    head = matrix(numbers, places, HEAD)
    for begin in range(0, len(q), BLOCK):
        end = min(begin + BLOCK, len(q))
        lanes, size, actions = end - begin, q.shape[1], u.shape[1]
        lead = matrix(numbers, places, int(head[0, LEAD]))
        raw = np.empty((size + actions + lead.shape[1], lanes))
        for b in range(lanes):
            for c in range(size):
                raw[c, b] = q[begin + b, c]
            for f in range(actions):
                raw[size + f, b] = u[begin + b, f]
        columns = matrix(numbers, places, int(head[0, OUTPUTS]))
        mean, spread = np.zeros((len(columns), lanes)), np.zeros((deviation.shape[1], lanes))
        shake = process[begin:end] if len(process) else process
        _predict_changes(numbers, places, head, raw, size, shake, deviations, reward_deviation, mean, spread)
        arrived = _arrive(numbers, places, head, raw[:size], mean)
        state = arrived if head[0, READS_AFTER] else raw[:size]
        pay = _pay(numbers, places, head, raw, size, actions, arrived, state, reward_deviation, mean, spread)
        over = _ended(numbers, places, head, arrived, actions)
        for b in range(lanes):
            for c in range(size):
                q_next[begin + b, c] = arrived[c, b]
            for o in range(len(spread)):
                deviation[begin + b, o] = spread[o, b]
            reward[begin + b], terminated[begin + b] = pay[b], over[b]


NO_PROCESS = np.zeros((0, 0))


@dataclass(frozen=True, eq=False)
class StepsOfModel(ArraySteps):
    """Steps of one model."""

    definition: EnvironmentDefinition
    tables: Tables
    outputs: int

    @classmethod
    def of(cls, predictor: Predictor, ending: Region | None) -> Self:
        """``ending`` is where episodes end, if that is learned."""
        return cls(predictor.definition, tables_of(predictor, ending), len(predictor.transitions) + 1)

    def __call__(
        self, q: Floats, u: Floats, process: Floats | None, *, deviations: bool, reward_deviation: bool
    ) -> ArrayTransition:
        count = len(q)
        moved = ArrayTransition(
            np.empty_like(q), np.empty(count), np.empty((count, self.outputs)), np.empty(count, dtype=np.bool_)
        )
        step(
            *self.tables,
            q,
            u,
            NO_PROCESS if process is None else process,
            deviations,
            reward_deviation,
            moved.q_next,
            moved.reward,
            moved.deviation,
            moved.terminated,
        )
        return moved
