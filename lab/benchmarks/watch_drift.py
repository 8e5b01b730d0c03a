"""After how many real steps ``surrogym watch`` finds that a plant has changed, and how often it is wrong.

A model of each plant from textbook physics (``support.levitation``) is fitted to one round of samples. A controller
runs the plant in closed loop, which changes at a random step, or has changed before the first one. The watcher sees the
same as on a server, in this process. Fouling takes 0.1 % of the actuator at each step.

A change shows only where it moves a state by more than its noise: a pendulum at rest does not feel its friction. So the
steps are counted from the change, and those of them at which it shows.

With ``--oracle``, a detector that knows both plants and the noise reads the same streams: CUSUM of the true
log-likelihood ratio of each step, which gives an alarm at the logarithm of 10,000, so that false alarms are as seldom
(Lorden 1971). It bounds what any detector can find. It knows when fouling began, too. Rewards have no noise, and would
show a change at once: their noise is taken to be the smallest that the watcher's detector knows, a tenth of the
tolerance.

With ``--units`` instead, healthy steps are converted to other units from the first step on, and the plants have changed
before it: how often the watcher names the unit, and how often it takes a change for one.

Run it by::

    python lab/benchmarks/watch_drift.py --first-seed 460 --seeds 3 --oracle
    python lab/benchmarks/watch_drift.py --first-seed 460 --seeds 3 --units
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import torch
from common import parser, started, write
from scipy.linalg import solve_discrete_are

from support.changing import Array, Changing, Machine
from support.levitation import PLANTS
from support.real_steps import arrays, samples_of
from surrogym_client.transport import Api
from surrogym_server.convert import definition_from_spec
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.design import Decision, advance, initial_queries
from surrogym_server.sampling.state import DesignState, Request
from surrogym_server.sampling.uncertainty import query_uncertainty
from surrogym_shared.spec import Design
from surrogym_shared.wire import SurrogateView
from surrogym_trainer.evaluation.comparing import StepOfEpisode
from surrogym_trainer.watching.detector import NEGLIGIBLE
from surrogym_trainer.watching.units import DEGREES, converted
from surrogym_trainer.watching.watcher import BATCH, Alarm, Watcher

HEALTHY = 7_000  # steps of the unchanged plant, for each plant and seed
BEFORE = 200  # steps before a change, and up to one episode more
AFTER = 400
AIM = 30  # steps
EPISODES = 50  # of a mean return
FOUND_BY = ("steps", "oracle")  # fields of a row
FALSE_ALARM_STEPS = 10_000  # as `surrogym watch` has it
Change = Callable[[Machine, int], dict[str, float]]  # the plant, steps since the change: parameters


def _offset(machine: Machine, _: int) -> dict[str, float]:
    low, high = next(iter(machine.ranges.values()))
    return {"shift": 0.02 * (high - low)}


CHANGES: Mapping[str, Change] = {
    "mass +30 %": lambda machine, _: {"mass": 1.3 * machine.real["mass"]},
    "friction x 2": lambda machine, _: {"friction": 2 * machine.real["friction"]},
    "dead time +1": lambda *_: {"delay": 1.0},
    "offset 2 %": _offset,
    "slow fouling": lambda machine, since: {"pump": machine.real["pump"] * 0.999**since},
    "worn actuator": lambda machine, _: {"pump": 0.8 * machine.real["pump"]},
}
DEAD: Mapping[str, Change] = {"dead actuator": lambda *_: {"pump": 0.0}, "a tenth": lambda *_: {"pump": 0.1}}
NEEDS = {"mass +30 %": "mass", "friction x 2": "friction"}  # parameter that a plant has or not


@dataclass(frozen=True)
class Row:
    """One change of one plant. Steps are None if it was not found."""

    plant: str
    change: str
    seed: int
    at_once: bool  # whether the plant has changed before the first step
    steps: int | None  # from the change up to the alarm
    shown: int | None  # those of these steps at which the change moves a state by more than its noise
    output: str
    region: str
    lost: float | None  # share of the controller's gain that the fouling has cost at the alarm
    oracle: int | None = None  # steps from the change up to the alarm of a detector that knows both plants


class Stream(NamedTuple):
    steps: list[StepOfEpisode]
    showing: list[bool]  # whether the change moves a state by more than its noise
    ratios: list[float]  # log-likelihood of each step in the changed plant, minus that in the healthy plant


class Served:
    """The routes of a server that a watcher asks, for a model in this process."""

    def __init__(self, made: Decision) -> None:
        self._model: DynamicsModel = made.model
        self._tolerances = np.array(made.tolerances)

    def predict(self, _: str, q: Any, u: Any, **__: Any) -> SimpleNamespace:
        with torch.inference_mode():
            found = self._model.transition(torch.tensor(q), torch.tensor(u))
        return SimpleNamespace(
            next_coordinates=found.q_next.tolist(), reward=found.reward.tolist(), terminated=[False] * len(q)
        )

    def query_uncertainty(self, _: str, q: Any, u: Any, **__: Any) -> SimpleNamespace:
        with torch.inference_mode():
            found = query_uncertainty(self._model, np.array(q), np.array(u), self._tolerances)
        return SimpleNamespace(outputs=list(self._model.definition.outputs), deviation=found.std)


class Case(NamedTuple):
    """A plant with its model and its controller."""

    machine: Machine
    served: Served
    view: SurrogateView
    act: Callable[[Array], Array]
    reward_noise: float  # standard deviation of the reward that an oracle takes

    def watcher(self) -> Watcher:
        return Watcher(cast(Api, self.served), self.view, FALSE_ALARM_STEPS)


def fitted(machine: Machine, seed: int) -> Case:
    design = Design(initial=machine.budget, budget=machine.budget, seed=seed)
    spec = machine.spec.model_copy(update={"design": design})
    plant, definition = Changing(machine, machine.real, np.random.default_rng([seed, 1])), definition_from_spec(spec)
    points = zip(*(one.numpy() for one in arrays(initial_queries(definition, machine.budget))), strict=True)
    samples = samples_of([plant.step_from(*point) for point in points])
    made = advance(definition, samples, DesignState(), Request(machine.budget, spec.design.target))
    outputs = [
        SimpleNamespace(name=name, tolerance=tolerance, leave_one_out_error=one.leave_one_out_error, noise=one.noise)
        for name, tolerance, one in zip(definition.outputs, made.tolerances, made.confidences, strict=True)
    ]
    view = SimpleNamespace(name="plant", spec=spec, model_version=1, fidelity=SimpleNamespace(outputs=outputs))
    least = NEGLIGIBLE * dict(zip(definition.outputs, made.tolerances, strict=True))["reward"]
    return Case(machine, Served(made), cast(SurrogateView, view), controller(machine), least)


def controller(machine: Machine) -> Callable[[Array], Array]:
    """A linear-quadratic regulator about the middle; the pendulum swings up by its energy first."""

    def after(q: Array, u: Array) -> Array:
        return machine.formula(q[None], u[None], machine.real)[0][0]

    size, small = len(machine.ranges), 1e-5
    middle, hold = np.zeros(size), np.array([3 / 2.2 - 1 if machine.name == "tanks" else 0.0])
    a = np.stack([(after(middle + d, hold) - after(middle - d, hold)) / (2 * small) for d in small * np.eye(size)], 1)
    b = (after(middle, hold + small) - after(middle, hold - small))[:, None] / (2 * small)
    spans = np.array([high - low for low, high in machine.ranges.values()])
    cost = 0.05 * np.eye(1)
    p = solve_discrete_are(a, b, np.diag(1 / spans**2), cost)
    gain = np.linalg.solve(cost + b.T @ p @ b, b.T @ p @ a)

    def act(q: Array) -> Array:
        u = hold - q @ gain.T
        if machine.name == "pendulum":
            lacking = 15 - (0.5 * q[:, 1] ** 2 + 15 * np.cos(q[:, 0]))
            swing = (0.4 * np.where(q[:, 1] < 0, -1, 1) * lacking)[:, None]
            u = np.where(np.abs(q[:, :1]) < 0.35, u, swing)
        clipped: Array = u.clip(-1, 1)
        return clipped

    return act


def stream_of(case: Case, change: Change | None, at: int, count: int, seed: int) -> Stream:
    """Steps of the closed loop from the declared starts, episode after episode."""
    machine, rng = case.machine, np.random.default_rng([seed, 5])
    low, high = np.array(list(machine.start.values())).T
    spans = np.array([end - begin for begin, end in machine.ranges.values()])
    found, showing, ratios, q, t, before = [], [], [], None, 0, np.zeros((1, machine.actions))
    for i in range(count):
        if q is None:
            q, t, before = rng.uniform(low, high)[None], 0, np.zeros((1, machine.actions))
        u = case.act(q)
        new = change(machine, i - at) if change is not None and i >= at else {}
        taken, parameters = before if new.get("delay") else u, {**machine.real, **new}
        q_next, reward, over = machine.step(q, taken, parameters, rng)
        shift = new.get("shift", 0.0) * np.eye(len(low))[0]
        moved = machine.formula(q - shift, taken, parameters)[0] + shift - machine.formula(q, u, machine.real)[0]
        showing.append(bool((np.abs(moved) > machine.noise * spans).any()))
        if change is not None:
            ratios.append(log_ratio(case, change(machine, max(i - at, 0)), (q, u, before), q_next, reward))
        state, action, following = (tuple(one[0].tolist()) for one in (q, u, q_next))
        found.append(StepOfEpisode(0, i, state, action, following, float(reward[0]), terminated=False))
        t, before = t + 1, u
        q = None if over[0] or t == machine.time_limit else q_next
    return Stream(found, showing, ratios)


def log_ratio(
    case: Case, new: Mapping[str, float], step: tuple[Array, Array, Array], q_next: Array, reward: Array
) -> float:
    """Log-likelihood ratio of one step, of a changed plant to the healthy one.

    Args:
        case: the plant.
        new: parameters of the changed plant.
        step: state (1, C), action (1, F) and the action before (1, F).
        q_next: next state (1, C).
        reward: (1,).
    """
    machine, (q, u, before) = case.machine, step
    spans = np.array([high - low for low, high in machine.ranges.values()])
    scale = np.append(machine.noise * spans, case.reward_noise)
    shift = new.get("shift", 0.0) * np.eye(q.shape[1])[0]
    healthy = machine.formula(q, u, machine.real)
    changed = machine.formula(q - shift, before if new.get("delay") else u, {**machine.real, **new})

    def squares(moved: Array, paid: Array) -> float:
        off = (q_next - moved)[0]
        turns = np.array([name in machine.angles for name in machine.ranges])
        off = np.where(turns, (off + np.pi) % (2 * np.pi) - np.pi, off)
        return float(((np.append(off, reward - paid) / scale) ** 2).sum())

    return (squares(*healthy) - squares(changed[0] + shift, changed[1])) / 2


def oracle_steps(stream: Stream, at: int) -> int | None:
    """Steps from the change up to the alarm of CUSUM, which begins again after each false alarm before the change."""
    total = 0.0
    for i, ratio in enumerate(stream.ratios):
        total = max(total, 0.0) + ratio
        if total >= np.log(FALSE_ALARM_STEPS):
            if i >= at:
                return i + 1 - at
            total = 0.0
    return None


def first_alarm(watcher: Watcher, steps: Sequence[StepOfEpisode]) -> Alarm | None:
    for first in range(0, len(steps), BATCH):
        if (alarm := watcher.take(steps[first : first + BATCH])) is not None:
            return alarm
    return None


def rows_of(case: Case, seed: int) -> Iterator[Row]:
    for number, (name, change) in enumerate(CHANGES.items()):
        if NEEDS.get(name, "pump") not in case.machine.real:
            continue
        for at_once in (False, True):
            own = seed + 1_000 * (number + 1)
            at = 0 if at_once else BEFORE + int(np.random.default_rng(own).integers(case.machine.time_limit))
            stream = stream_of(case, change, at, at + AFTER, own)
            oracle = oracle_steps(stream, at)
            alarm = first_alarm(case.watcher(), stream.steps)
            if alarm is None or alarm.line < at:
                early = "" if alarm is None else "a false alarm before"
                yield Row(case.machine.name, name, seed, at_once, None, None, early, "", None, oracle)
                continue
            end = alarm.line + 1
            shown = sum(stream.showing[at:end])
            lost = lost_share(case, change(case.machine, end - at), seed) if name == "slow fouling" else None
            where = "" if alarm.region is None else alarm.region.words()
            yield Row(case.machine.name, name, seed, at_once, end - at, shown, alarm.output, where, lost, oracle)


def lost_share(case: Case, parameters: dict[str, float], seed: int) -> float:
    """Share of the controller's gain over no action that a change costs."""

    def mean(new: dict[str, float], act: Callable[[Array], Array]) -> float:
        machine, rng = case.machine, np.random.default_rng([seed, 77])
        low, high = np.array(list(machine.start.values())).T
        q, total = rng.uniform(low, high, (EPISODES, len(low))), np.zeros(EPISODES)
        running = np.ones(EPISODES, bool)
        for _ in range(machine.time_limit):
            q, reward, over = machine.step(q, act(q), {**machine.real, **new}, rng)
            total += np.where(running, reward, 0.0)
            running &= ~over
        return float(total.mean())

    idle = mean({}, lambda q: np.zeros((len(q), case.machine.actions)))
    real = mean({}, case.act)
    return (real - mean(parameters, case.act)) / max(real - idle, 1e-9)


def false_alarms(case: Case, seed: int, count: int) -> list[str]:
    """The false alarms of a healthy stream, which is watched anew after each."""
    steps, found = stream_of(case, None, 0, count, seed).steps, []
    while (alarm := first_alarm(case.watcher(), steps)) is not None:
        found.append(alarm.words())
        steps = steps[alarm.compared :]
    return found


def units_of(case: Case, seed: int) -> Counter[str]:
    """Counts of converted steps and of plants that had changed before the first step: how many give an alarm, and in
    how many of these the watcher names the right unit, another one, or a unit in place of a change."""
    machine, found = case.machine, Counter[str]()
    width = len(machine.ranges) + machine.actions + 1
    healthy = stream_of(case, None, 0, AFTER, seed).steps
    factors = (10.0, DEGREES, 1_000.0, 0.001)
    tried: list[tuple[tuple[int, ...], float]] = [((i,), one) for i in range(len(machine.ranges)) for one in factors]
    tried += [((width - 1,), factor) for factor in (1_000.0, -1.0, 0.01)] + [((width - 2,), 0.01)]
    tried += [((0, 1), DEGREES)] if machine.angles else []
    for places, factor in tried:
        scale = np.ones(width)
        scale[list(places)] = factor
        watcher = case.watcher()
        if first_alarm(watcher, converted(healthy, scale, np.zeros(width))) is not None:
            units, names = watcher.other_units()[0], [*machine.ranges, "action 0", "reward"]
            right = units is not None and units.names == tuple(names[place] for place in places)
            right = right and units is not None and bool(np.isclose(units.factor, factor, rtol=0.01))
            found.update(["converted", "right unit" if right else "no unit" if units is None else "another unit"])
    for number, (name, change) in enumerate({**CHANGES, **DEAD}.items()):
        if NEEDS.get(name, "pump") in machine.real:
            watcher = case.watcher()
            if first_alarm(watcher, stream_of(case, change, 0, AFTER, seed + 1_000 * (number + 1)).steps) is not None:
                found.update(["changed", *(["changed, but a unit"] if watcher.other_units()[0] else [])])
    return found


def table(rows: Sequence[Row], *, oracle: bool) -> str:
    head = [
        *("plant", "change", "runs", f"found within {AIM}", "steps: median, most", "of these show it"),
        "changed before: within, median, most",
        *(["oracle: within, median, most", "oracle, changed before"] if oracle else []),
    ]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for plant, change in dict.fromkeys((row.plant, row.change) for row in rows):
        own = [row for row in rows if (row.plant, row.change) == (plant, change)]
        later, at_once = [one for one in own if not one.at_once], [one for one in own if one.at_once]
        cells = [plant, change, str(len(later)), _within(later), _steps(later), _shown(later)]
        cells.append(f"{_within(at_once)}, {_steps(at_once)}")
        for some in (later, at_once) if oracle else ():
            known = [replace(row, steps=row.oracle) for row in some]
            cells.append(f"{_within(known)}, {_steps(known)}")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _within(rows: Sequence[Row]) -> str:
    return f"{sum(row.steps is not None and row.steps <= AIM for row in rows)} of {len(rows)}"


def _steps(rows: Sequence[Row]) -> str:
    steps = [np.inf if row.steps is None else row.steps for row in rows]
    return f"{np.median(steps):g}, {max(steps):g}"


def _shown(rows: Sequence[Row]) -> str:
    shown = [np.inf if row.shown is None else row.shown for row in rows]
    return f"{np.median(shown):g}, {max(shown):g}"


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--first-seed", type=int, default=400)
    made.add_argument("--seeds", type=int, default=3)
    made.add_argument("--oracle", action="store_true", help="show what a detector finds that knows both plants")
    made.add_argument("--units", action="store_true", help="show how steps in other units are told from a change")
    options = started(made)
    if options.units:
        seeds = range(options.first_seed, options.first_seed + (1 if options.quick else options.seeds))
        counts = {f"{m.name} {seed}": units_of(fitted(m, seed), seed) for m in PLANTS for seed in seeds}
        print(dict(sum(counts.values(), Counter())))
        write(options.out, "watch-units", counts)
        return
    rows: list[Row] = []
    wrong: dict[str, list[str]] = {}
    steps = 500 if options.quick else HEALTHY
    for machine in PLANTS:
        for seed in range(options.first_seed, options.first_seed + (1 if options.quick else options.seeds)):
            case = fitted(machine, seed)
            rows += rows_of(case, seed)
            wrong[f"{machine.name} {seed}"] = false_alarms(case, seed, steps)
            print(f"{machine.name} {seed}: {len(wrong[f'{machine.name} {seed}'])} false alarms in {steps} steps")
    lost = [row.lost for row in rows if row.lost is not None]
    print(table(rows, oracle=options.oracle))
    within = {name: sum((getattr(row, name) or AFTER) <= AIM for row in rows if not row.at_once) for name in FOUND_BY}
    print(f"found within {AIM} steps of {sum(not row.at_once for row in rows)}: {within}")
    print(f"false alarms: {sum(map(len, wrong.values()))} in {steps * len(wrong)} healthy steps")
    print(f"gain lost by fouling at the alarm: median {np.median(lost):.1%}, most {max(lost):.1%}")
    write(options.out, "watch-drift", {"rows": [asdict(row) for row in rows], "false_alarms": wrong, "steps": steps})


if __name__ == "__main__":
    main()
