"""How many real steps a prior saves: a plant whose parameters are off, beside the textbook's simulator of it.

    python lab/benchmarks/bench_priors.py --task swingup acrobot --first-seed 1000 --seeds 8
    python lab/benchmarks/bench_priors.py --task swingup --access reset --without friction --first-seed 1000 --seeds 8

For each seed, the plant's parameters are the textbook's, times factors drawn evenly from 0.7 to 1.3. The reactor is the
one of examples/reactor.py, and its simulator's activation energy has the factor. ball_in_cup needs dm_control. The arms
are:

- cold: a design without a prior;
- rough: beside a model of the simulator as it is;
- calibrated: beside a model of the simulator with calibrated parameters;
- wrong: beside a model of the simulator whose actions are turned round, calibrated all the same;
- other: beside a calibrated model of another machine: its parameters are five times the textbook's, or a fifth of them;
- alone: a model of the simulator as it is, in place of the plant, without a real step;
- stepped: the simulator itself, calibrated on the real steps of a cold design, without a model of either.

A row has the design's phase and real steps, the largest error of a step (of the standard deviation of the changes,
over 300 states drawn from the sampling range), and with ``--policy`` the mean real return of 50 episodes of a policy
that was trained in the model, the share of them that succeed, and the policy's promise. ``--without`` names a
parameter that the simulator lacks: it is 0 there. Rows are kept in ``--out``/priors.csv, so that the same command
goes on after Ctrl-C.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

import numpy as np
import reactor
import torch
from common import OUT

import surrogym
from surrogym_lab.reproduce.rows import read_records, write_records
from surrogym_sampler import original
from surrogym_sampler.original.episodes import SteppedEpisode
from surrogym_sampler.original.protocol import RealStep
from surrogym_sampler.priors.calibration import adjustable
from surrogym_server.environment.actions import model_actions
from surrogym_server.local import LocalSurrogate
from surrogym_shared.spec import BoxAction, EnvironmentSpec
from surrogym_trainer.evaluation.evaluator import EvaluationSettings, evaluate
from surrogym_trainer.evaluation.promise import promise_of
from surrogym_trainer.policies import load_policy
from surrogym_trainer.training import TrainSettings, train


class Tank(reactor.Reactor):
    """The reactor of the examples, with its activation energy as an attribute."""

    activation = 8750.0  # K

    def step_from(self, coordinates: Any, action: Any) -> RealStep:
        def derivative(concentration: float, temperature: float, coolant: float) -> tuple[float, float]:
            rate = 7.2e10 * np.exp(-self.activation / temperature) * concentration
            return 1.0 - concentration - rate, 350.0 - temperature + 209.2 * rate + 2.092 * (coolant - temperature)

        reactor.derivative = derivative
        return super().step_from(coordinates, action)


TASKS: dict[str, tuple[str, tuple[str, ...], int]] = {  # environment, its parameters, the budget of the cold design
    "swingup": ("surrogym/CartPoleSwingUp-v0", ("masscart", "masspole", "length", "friction"), 120),
    "acrobot": ("Acrobot-v1", ("LINK_LENGTH_1", "LINK_MASS_1", "LINK_MASS_2", "LINK_MOI"), 200),
    "cartpole": ("CartPole-v1", ("masscart", "masspole", "length", "force_mag"), 60),
    "pendulum": ("Pendulum-v1", ("m", "l"), 30),
    "doublependulum": ("InvertedDoublePendulum-v5", ("mass.cart", "mass.pole", "mass.pole2", "gear.slide"), 250),
    "reactor": ("bench_priors:Tank", ("activation",), 30),
    "ball_in_cup": (
        "dm_control:ball_in_cup-catch",
        ("mass.cup", "mass.ball", "damping.cup_x", "damping.cup_z", "friction.ball", "gear.x", "gear.z"),
        1_000,
    ),
}
DRAFT = Path(__file__).parent / "larger" / "ball_in_cup-catch.json"  # its specification
ARMS = ("cold", "rough", "calibrated", "wrong", "other", "alone", "stepped")
ANOTHER = 5.0  # factor or divisor of each parameter of another machine
OFF = 0.3  # default of the largest share by which a parameter is off
USUAL_RANGE = 0.5  # with a larger share, parameters get wider ranges than half to twice the simulator's own value
TESTS = 300
SEARCH = "FASTPPO"


@dataclass(frozen=True)
class Row:
    """One design."""

    task: str
    access: str
    without: str
    off: float
    arm: str
    seed: int
    phase: str
    steps: int
    error: float  # largest of the outputs' errors
    uses: int  # outputs that use the prior
    inside: int  # calibrated parameters whose 90 % interval holds the true value
    parameters: int  # calibrated
    value: float  # mean real return of the policy; nan without --policy
    success: float  # share of its episodes that succeed; nan without --policy, or if success is not declared
    low: float  # its promise, the interval in which the model expects its mean real return; nan for a planner
    high: float


class Turned:
    """A simulator in which actions work the other way round."""

    parallel = True

    def __init__(self, inner: Any) -> None:
        self.wrapped = inner

    def spec(self) -> EnvironmentSpec:
        return self.wrapped.spec()

    def step_from(self, coordinates: Any, action: Any) -> RealStep:
        space = self.spec().action
        turned = -np.asarray(action) if isinstance(space, BoxAction) else space.n - 1 - np.asarray(action)
        return replace(self.wrapped.step_from(coordinates, turned), action=action)

    def close(self) -> None:
        self.wrapped.close()


def main() -> None:
    options = _options()
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    path: Path = options.out / "priors.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = read_records(path, Row)
    done = {(row.task, row.access, row.without, row.off, row.arm, row.seed) for row in rows}
    for task in options.task:
        for seed in range(options.first_seed, options.first_seed + options.seeds):
            for arm in options.arms:
                if (task, options.access, options.without, options.off, arm, seed) in done:
                    continue
                chosen = (options.access, options.without, options.off)
                rows.append(run(task, *chosen, arm, seed, policy=options.policy, budget=options.budget))
                write_records(path, Row, rows)
                print(rows[-1])


def run(
    task: str, access: str, without: str, off: float, arm: str, seed: int, *, policy: str, budget: int | None = None
) -> Row:
    name, names, usual = TASKS[task]
    budget = budget or usual
    rng = np.random.default_rng([seed, 77])
    factors, far = rng.uniform(1 - off, 1 + off, len(names)), ANOTHER ** rng.choice([-1, 1], len(names))

    def plant(access: Any = "any") -> Any:
        made = _made(name, budget=budget, seed=seed, access=access)
        return made if task == "reactor" else scaled(made, names, factors)

    spec, truth = plant(access).spec(), adjustable(plant()).parameters()
    simulator: Any = _made(name)
    if arm == "other" or task == "reactor":
        scaled(simulator, names, far if arm == "other" else factors)
    if without:
        adjustable(simulator).set_parameters({without: 0.0})
    if arm == "wrong":
        simulator = Turned(simulator)
    calibrated = [one for one in names if one != without] if arm in ("calibrated", "wrong", "other", "stepped") else []
    if off > USUAL_RANGE:
        own = adjustable(simulator).parameters()
        calibrated = [f"{one}={own[one] * (1 - off) / 2}..{own[one] * (1 + off) * 2}" for one in calibrated]
    prior = None if arm == "cold" else surrogym.Prior(simulator, spec, calibrated)
    if arm == "alone" and prior is not None:
        model, phase, steps = LocalSurrogate.from_bytes(spec, prior.learned()[0].model), "alone", 0
    else:
        beside = None if arm == "stepped" else prior
        design, machine, real = surrogym.Design(spec, budget=budget, prior=beside, threads=2), plant(access), []
        while (query := design.ask()) is not None:
            answer = answered(machine, query, seed, design)
            design.tell(query, answer)
            real += answer
        model, phase, steps = design.surrogate(), design.phase, design.steps
        if arm == "stepped" and prior is not None:
            prior.calibrate(real)
            model = prior.stepped()
    found = () if prior is None or prior.calibration is None else prior.calibration.parameters
    return Row(
        *(task, access, without, off, arm, seed, phase, steps, error_of(model, plant(), seed)),
        sum(one.startswith("prior + ") for one in model.model.structures),
        sum(one.low <= truth[one.name] <= one.high for one in found),
        len(found),
        *(earned(model, plant, seed, policy) if policy else [float("nan")] * 4),
    )


def _made(name: str, **choices: Any) -> Any:
    draft = DRAFT.read_bytes() if DRAFT.stem in name else None
    spec = None if draft is None else EnvironmentSpec.model_validate(json.loads(draft)["specification"])
    return original.make(name, spec=spec, **choices)


def scaled(environment: Any, names: tuple[str, ...], factors: Any) -> Any:
    """The environment, whose parameters ``names`` (P,) are multiplied by ``factors`` (P,)."""
    plain = adjustable(environment)
    known = plain.parameters()
    plain.set_parameters({one: known[one] * by for one, by in zip(names, factors.tolist(), strict=True)})
    return environment


def answered(plant: Any, query: surrogym.Query, seed: int, design: surrogym.Design) -> list[RealStep]:
    if query.coordinates:
        return [plant.step_from(np.array(query.coordinates), np.array(query.action))]
    acting, state, taken = design.acting(query), plant.begin(1_000 * seed + query.id), list[RealStep]()
    for number in range(query.steps):
        taken.append(plant.act(np.array(acting(number, state))))
        state = np.asarray(taken[-1].next_coordinates)
        if taken[-1].terminated:
            break
    return taken


def error_of(model: LocalSurrogate, plant: Any, seed: int) -> float:
    """Largest root mean square error of a transition output, in standard deviations of its changes."""
    spec, rng = plant.spec(), np.random.default_rng([seed, 5])
    starts = np.stack([_drawn(one.sampling, rng) for one in spec.coordinates], 1)
    space = spec.action
    actions = (
        rng.uniform(space.low, space.high, (TESTS, space.size))
        if isinstance(space, BoxAction)
        else rng.integers(0, space.n, (TESTS, 1)).astype(float)
    )
    reached = np.array([plant.step_from(q, u).next_coordinates for q, u in zip(starts, actions, strict=True)])
    taken = model_actions(model.model.definition, actions)
    found = model.model.transition(torch.from_numpy(starts), torch.from_numpy(taken)).q_next.numpy()
    angles = np.array([one.kind == "angle" for one in spec.coordinates])

    def difference(one: Any, other: Any) -> Any:
        return np.where(angles, (one - other + np.pi) % (2 * np.pi) - np.pi, one - other)

    size = difference(reached, starts).std(0)
    errors = np.sqrt((difference(found, reached) ** 2).mean(0))
    return float((errors[size > 0] / size[size > 0]).max())


def _drawn(sampling: Any, rng: np.random.Generator) -> Any:
    if sampling.kind == "normal":
        return rng.normal(sampling.mean, sampling.std, TESTS)
    return rng.uniform(sampling.low, sampling.high, TESTS)


def earned(model: LocalSurrogate, plant: Callable[[], Any], seed: int, by: str) -> tuple[float, float, float, float]:
    """Mean real return of a policy that was trained in the model, or of a planner on it (``by``), the share of its
    episodes that succeed, and both ends of its promise before any audit."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "policy.zip"
        train(model, path, TrainSettings(by, seed=seed))
        predict = load_policy(path, by)
    found = evaluate(predict, lambda: SteppedEpisode(plant()), EvaluationSettings(50, 10_000))
    success = float("nan") if found.success_rate is None else found.success_rate
    # a planner's takes too long here, and a simulator in the place of a model knows no doubt
    promise = promise_of(model, predict, seed) if by == SEARCH and model.model.digest != "stepped" else None
    ends = (float("nan"), float("nan")) if promise is None else (promise.low, promise.high)
    return float(np.mean(found.returns)), success, *ends


def _options() -> argparse.Namespace:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--task", nargs="+", choices=TASKS, default=["swingup"])
    made.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS))
    made.add_argument("--access", choices=("any", "reset"), default="any")
    made.add_argument("--without", default="", help="parameter that the simulator lacks")
    made.add_argument("--off", type=float, default=OFF, help="largest share by which a parameter of the plant is off")
    made.add_argument("--budget", type=int, help="real steps that a design may take [default: those of a cold one]")
    made.add_argument("--first-seed", type=int, default=0)
    made.add_argument("--seeds", type=int, default=1)
    made.add_argument(
        "--policy", nargs="?", const=SEARCH, default="", help="measure the real return of a policy by this search"
    )
    made.add_argument("--out", type=Path, default=OUT)
    torch.set_num_threads(1)
    return made.parse_args()


if __name__ == "__main__":
    main()
