"""Which mechanisms of the Gaussian processes change a model, and whether its predictions of unseen steps get better.

python lab/benchmarks/bench_ablation.py --seeds 2060 2061
python lab/benchmarks/bench_ablation.py --many --seeds 2060 2061
python lab/benchmarks/bench_ablation.py --rules --seeds 2060 2061

Each plant is sampled once for each seed and number of samples: by a Latin hypercube, or by random rollouts if it can
only be reset. A model is learned from these samples. For each mechanism that this model uses, another model is learned
from the same samples without the mechanism. With ``--all``, this is done for mechanisms that the model does not use
too. Both models predict the same 500 unseen steps of the plant.

``scored`` of ``structures`` has the scores: root mean square error in standard deviations of the output, and mean log
density, with the learned noise. Of a learned termination, the error is the share of wrong labels. ``gain`` is the log
density with the mechanism less that without it. With ``--many`` the models have 400 and 2,300 samples.

With ``--rules`` adaptive designs are run instead, and the table has the rounds in which each rule chose queries, or
reserved candidates. Three tasks need MuJoCo, two need pythonfmu.
"""

from __future__ import annotations

import importlib
import json
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar
from unittest.mock import patch

sys.path.insert(0, str(Path(__file__).parents[2] / "examples" / "fmus"))
sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import torch
from common import parser, started, write
from machines import Ball, Block, Chain, Crane, Drone, Rooms, Tanks
from structures import hypercube, real_steps, scored
from torch import Tensor

import surrogym
from support.changing import MACHINES, Changing
from support.fermenter import Fermenter
from support.hidden_bump import HiddenBump
from support.levitation import PLANTS as TEXTBOOK
from support.models import gaussian_processes
from support.reactor import MAPPING, example
from support.real_steps import samples_of
from support.van_de_vusse import VanDeVusse
from surrogym.demo.tasks import TASKS as DEMOS
from surrogym_lab.unseen import tasks as unseen
from surrogym_sampler.original import RealStep, make
from surrogym_sampler.original.describing import describe
from surrogym_sampler.original.rollouts import answering
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition, wrap
from surrogym_server.environment.distributions import scaling
from surrogym_server.environment.features import FeatureMap
from surrogym_server.environment.samples import Samples
from surrogym_server.models.gaussian_process.learning import dropping, learn, output_learner, region, reward
from surrogym_server.models.gaussian_process.learning import thresholds as thresholds_
from surrogym_server.models.gaussian_process.learning.output_learner import OutputLearner
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.several import FunctionsOfSeveral
from surrogym_server.sampling import design, judging
from surrogym_server.sampling.latin_hypercube import going_on, random_points
from surrogym_server.sampling.rollouts import random_sequences
from surrogym_shared.spec import REWARD, Bounds, DeclaredReward, Design, DiscreteAction, EnvironmentSpec, Reward

SIZES, MANY, BUDGET = (20, 40, 100), (400, 2_300), 100
UNSEEN, UNSEEN_SEED, LONGEST = 500, 4_099, 50  # unseen steps, and the longest of their rollouts
SAME = 1e-9  # difference of two predictions, in standard deviations of the output, that may be rounding
REACTOR = example()


def definition_of(original: Any, settings: Mapping[str, Any]) -> EnvironmentDefinition:
    """The definition of a plant whose reward is learned, with settings of the processes."""
    spec = original.spec()
    design = Design.model_validate({"model": {"name": "gaussian_process", "settings": dict(settings)}})
    reward = spec.reward if isinstance(spec.reward, Reward) else Reward(timing=spec.reward.timing)
    return definition_from_spec(spec.model_copy(update={"design": design, "reward": reward}))


class With:
    """A plant with process noise, a share of each range, with a bonus in the upper fifth of the first coordinate's
    range, or with another specification."""

    def __init__(self, original: Any, process: float = 0.0, bonus: float = 0.0, **changed: Any) -> None:
        self.original, self.process, self.bonus, self.changed = original, process, bonus, changed
        self.rng = np.random.default_rng(5)
        coordinates = definition_of(original, {}).coordinates
        self.spans = 12**0.5 * np.array([scaling(c.sampling)[1] for c in coordinates])  # of uniform ranges

    def spec(self) -> EnvironmentSpec:
        return self.original.spec().model_copy(update=self.changed)

    def step_from(self, coordinates: Any, action: Any) -> Any:
        step = self.original.step_from(coordinates, action)
        moved = self.process * self.spans * self.rng.standard_normal(len(self.spans))
        low, high = next(iter(self.original.ranges.values())) if self.bonus else (0.0, 0.0)
        paid = self.bonus * bool(coordinates[0] > low + 0.8 * (high - low)) if self.bonus else 0.0
        return replace(step, next_coordinates=np.asarray(step.next_coordinates) + moved, reward=step.reward + paid)

    def close(self) -> None:
        """Nothing is held."""


class Moves(unseen.NarrowPlane):
    """A boat with five discrete actions, whose numbers have no order: stay, or go one way."""

    ways: ClassVar[np.ndarray] = np.array([[0, 0], [1, 0], [0, -1], [-1, 0], [0, 1]])

    def spec(self) -> EnvironmentSpec:
        return super().spec().model_copy(update={"action": DiscreteAction(n=len(self.ways))})

    def formula(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        after, _ = super().formula(q, self.ways[u.astype(int)[..., 0]])
        return after, -(q**2).sum(-1)

    def step_from(self, coordinates: Any, action: Any) -> RealStep:
        after, reward = self.formula(np.asarray(coordinates, dtype=float), np.atleast_1d(np.asarray(action)))
        return RealStep(coordinates, action, after, float(reward))


def _two_sided() -> Any:
    """The reactor with two limits for each coordinate, as the mapping of its log declares them."""
    plant = REACTOR.Reactor()
    bounds = [Bounds(**dict(zip(("low", "high"), MAPPING["limits"][name], strict=True))) for name in ("c", "T")]
    pairs = zip(plant.spec().coordinates, bounds, strict=True)
    return With(plant, coordinates=tuple(c.model_copy(update={"bounds": b}) for c, b in pairs))


def _fmu(name: str) -> Any:
    """The plant in an FMU of the examples, with the specification that ``describe`` drafts of the FMU."""
    control: Any = importlib.import_module("control")
    terms, start = control.GOALS[name]
    with TemporaryDirectory() as folder:
        spec = describe(f"fmu:{control.built(name, Path(folder))}").spec
    declared = DeclaredReward(kind="declared", timing="after", terms=terms)
    return control.Plant(name, spec.model_copy(update={"reward": declared, "start": start}))


def _drafted(name: str) -> Any:
    stored = json.loads((Path(__file__).parent / "larger" / f"{name}.json").read_text())
    return make(name, spec=EnvironmentSpec.model_validate(stored["specification"]))


def _past(module: str, name: str, **lags: int) -> Any:
    return answering(getattr(importlib.import_module(module), name)(**lags))


NAMES = ("pendulum", "cartpole", "mountaincar", "acrobot", "swingup", "invertedpendulum", "doublependulum")
UNSEEN_TASKS = (
    unseen.NarrowPlane, unseen.NarrowArm, unseen.Kinetics, unseen.StickSlip, unseen.NoisyPendulum,
    unseen.NoisySensors, unseen.Contact, unseen.FastAndSlow, unseen.SpringChain,
)  # fmt: skip
PLANTS: dict[str, Callable[[], Any]] = {
    **{name: (lambda task=task: make(task.environment)) for name, task in DEMOS.items()},
    **{
        f"{name}, ends learned": (lambda name=name: With(make(DEMOS[name].environment), termination="learned"))
        for name in ("cartpole", "mountaincar", "acrobot", "invertedpendulum", "doublependulum")
    },
    **{f"{name}, noise": (lambda name=name: With(make(DEMOS[name].environment), 0.01)) for name in NAMES},
    **{f"{name}, reset": (lambda name=name: make(DEMOS[name].environment, access="reset")) for name in NAMES},
    **{f"{name}, snapshots": (lambda name=name: make(DEMOS[name].environment, access="snapshot")) for name in NAMES},
    **{
        f"{kind.__name__.lower()}, bonus": (lambda kind=kind: With(kind(), bonus=1.0)) for kind in (Tanks, Rooms, Drone)
    },
    "discrete moves": Moves,
    **{kind.__name__: kind for kind in UNSEEN_TASKS},
    "ResetOnly": lambda: answering(unseen.ResetOnly()),
    **{f"hidden reward, {n} inputs": (lambda n=n: HiddenBump(n, seed=n)) for n in (1, 2, 3, 4)},
    "hidden reward, cost": lambda: HiddenBump(2, seed=7, cost=0.1, toll=1.0),
    "reactor": REACTOR.Reactor,
    "reactor, two-sided": _two_sided,
    "reactor, noise": lambda: With(REACTOR.Reactor(), 0.01),
    "fermenter": Fermenter,
    "fermenter, noise": lambda: With(Fermenter(), 0.01),
    "van de vusse": VanDeVusse,
    **{kind.__name__.lower(): kind for kind in (Chain, Rooms, Crane, Drone, Tanks, Ball, Block)},
    **{f"{kind.__name__.lower()}, noise": (lambda kind=kind: With(kind(), 0.01)) for kind in (Chain, Rooms, Tanks)},
    **{f"textbook {m.name}": (lambda m=m: Changing(m, m.real)) for m in (*TEXTBOOK, *MACHINES)},
    "vessel, lags": lambda: _past("dead_time", "Vessel"),
    "vessel, more lags": lambda: _past("dead_time", "Vessel", changes=3, actions=8),
    "angle alone, lags": lambda: _past("hidden_speed", "AngleAlone"),
    "FMU tanks": lambda: _fmu("TwoTanks"),
    "FMU pendulum": lambda: _fmu("InvertedPendulum"),
    "hopper": lambda: _drafted("Hopper-v5"),
}

Used = Callable[[GaussianProcessModel], bool]
Patch = tuple[Any, str, Any]


@dataclass(frozen=True)
class Mechanism:
    """How a mechanism is left out, and whether a model uses it."""

    used: Used
    settings: Mapping[str, Any] = field(default_factory=dict)
    patches: Sequence[Patch] = ()


def _output(holds: Callable[[Any], bool]) -> Used:
    return lambda model: any(holds(output) for output in model.outputs)


def _of_map(holds: Callable[[FeatureMap], bool]) -> Mechanism:
    """Feature maps of a kind. If an output has no others, it keeps them."""
    allowed = OutputLearner.allowed

    def without(learner: OutputLearner, maps: tuple[FeatureMap, ...]) -> tuple[FeatureMap, ...]:
        maps = allowed(learner, maps)
        return tuple(m for m in maps if not holds(m)) or maps

    return Mechanism(_output(lambda o: holds(o.feature_map)), patches=[(OutputLearner, "allowed", without)])


def _unchanged(_: Any, output: Any, *_others: Any) -> Any:
    return output


def _no_quadratic(learner: OutputLearner, name: str, options: Any = OutputLearner.options) -> Any:
    return replace(options(learner, name), quadratic=False)


def _unlikely(*arguments: Any, classifier: Any = region._classifier) -> Any:
    return classifier(*arguments)[0], -1e6


def _forms(kind: str) -> Used:
    def used(model: GaussianProcessModel) -> bool:
        regions = [jump.region for jump in model.jumps] + ([] if model.ending is None else [model.ending])
        return any(type(form).__name__ == kind for each in regions for _, form in each.forms)

    return used


def _always(_: GaussianProcessModel) -> bool:
    return True


def _many(model: GaussianProcessModel) -> bool:
    return model.samples > 150


def _no_fit_through_few(*_: Any) -> None:
    return None


def _same_theta(_x: Any, _y: Any, _options: Any, theta: Any, *_: Any) -> Any:
    return theta


def _only_theta(x: Any, y: Any, options: Any, theta: Any, mirror: Any, refine: Any = output_learner.refine) -> Any:
    return refine(x, y, options, theta, mirror)[:1]


def _posterior(learner: Any, output: Any, posterior: Any, *_: Any) -> Any:
    return output


MECHANISMS: dict[str, Mechanism] = {
    "linear part": Mechanism(_always, {"kernel": "squared_exponential"}),
    "quadratic part of the reward": Mechanism(_always, patches=[(OutputLearner, "options", _no_quadratic)]),
    "symmetry": Mechanism(_output(lambda o: bool(o.feature_map.parity)), {"symmetry": "none"}),
    "rates": Mechanism(_output(lambda o: any(o.feature_map.rates)), {"rates": False}),
    "drop_inputs": Mechanism(_output(lambda o: bool(o.feature_map.dropped or o.shared)), {"drop_inputs": False}),
    "repeated_parts": Mechanism(_output(lambda o: bool(o.shared)), {"repeated_parts": False}),
    "reward_peaks": Mechanism(_output(lambda o: o.warp is not None), {"reward_peaks": False}),
    "reward_jumps": Mechanism(lambda model: bool(model.jumps), {"reward_jumps": False}),
    "limits of others": Mechanism(_output(lambda o: o.past_limits), patches=[(learn, "past_limits", _unchanged)]),
    "inequalities at the own limit": Mechanism(
        _output(lambda o: any(o.at_limit)), patches=[(learn, "within_limits", _unchanged)]
    ),
    "angle prediction": Mechanism(
        _output(lambda o: bool(o.feature_map.drift)), patches=[(learn, "learn_drift", lambda *_: ())]
    ),
    "maps: next speed": _of_map(lambda m: m.lead),
    "maps: next speed alone": _of_map(lambda m: m.lead and m.state == "none"),
    "maps: wrapped angle": _of_map(lambda m: m.state == "wrapped"),
    "maps: one-hot action": _of_map(lambda m: m.action == "one_hot"),
    "maps: observation": _of_map(lambda m: m.state == "observation"),
    "maps: reward after the step": _of_map(lambda m: m.after),
    "maps: fewer lags": _of_map(lambda m: m.history is not None),
    "maps: peak without action": Mechanism(
        _output(lambda o: o.feature_map.action == "none"), patches=[(reward, "_without_action", lambda *_: {})]
    ),
    "thresholds": Mechanism(_forms("Thresholds"), patches=[(region, "thresholds", lambda *_: [])]),
    "rival thresholds": Mechanism(_forms("Thresholds"), patches=[(thresholds_, "RIVALS", 1)]),
    "classifier of regions": Mechanism(_forms("Classifier"), patches=[(region, "_classifier", _unlikely)]),
    "many: several starts": Mechanism(_many, patches=[(output_learner, "refine", _only_theta)]),
    "many: hyperparameters of more than 150": Mechanism(
        _many,
        patches=[(output_learner, "fit_some", _same_theta), (output_learner, "fit_through_few", _no_fit_through_few)],
    ),
    "many: through few points": Mechanism(_many, patches=[(output_learner, "fit_through_few", _no_fit_through_few)]),
    "many: where errors are large": Mechanism(
        _many, patches=[(output_learner, "refine_where_hard", lambda posterior, *_: posterior.hyper)]
    ),
    "many: fewer inputs": Mechanism(_many, patches=[(dropping, "_of_many", _posterior)]),
}
SEVERAL = "uncertain hyperparameters"


def steps_of(original: Any, definition: EnvironmentDefinition, count: int, seed: int, *, spread: bool) -> Samples:
    """Real steps of a plant: a Latin hypercube (or random points), or random rollouts if it can only be reset."""
    rng = np.random.default_rng(seed)
    if definition.max_rollout is None:
        if spread:
            return hypercube(original, definition, count, seed)
        return real_steps(original, *going_on(definition, *random_points(definition, count, rng), rng))
    steps: list[Any] = []
    while len(steps) < count:
        original.begin(int(rng.integers(2**31)))
        for action in random_sequences(definition, 1, min(definition.max_rollout, LONGEST, count), rng)[0]:
            steps.append(original.act(action))
            if steps[-1].terminated or steps[-1].truncated:
                break
    samples = samples_of(steps)
    return samples.at(definition.known(samples.q).nonzero()[:count, 0])


@dataclass(frozen=True)
class Foretold:
    """Predictions of unseen steps: means and standard deviations with noise (K, m, O) of K equally likely models, and
    probabilities of the end of an episode (m,), if it is learned."""

    mean: Tensor
    std: Tensor
    end: Tensor | None


def foretold(models: Sequence[GaussianProcessModel], samples: Samples) -> Foretold:
    means, deviations = [], []
    for model in models:
        found = model.transition(samples.q, samples.u, stds=True, reward_std=True)
        assert found.std is not None
        assert found.reward_std is not None
        moving = list(model.definition.moving)
        change = found.q_next - samples.q
        change[:, model.definition.angles] = wrap(change[:, model.definition.angles])
        means.append(torch.cat([change[:, moving], found.reward[:, None]], 1))
        std = torch.cat([found.std, found.reward_std[:, None]], 1)
        deviations.append(torch.hypot(std, torch.tensor(model.noise_stds, dtype=std.dtype)))
    first = models[0]
    end = first.termination_probability(samples.q_next) if first.definition.learns_termination else None
    return Foretold(torch.stack(means), torch.stack(deviations), end)


def judged(definition: EnvironmentDefinition, found: Foretold, samples: Samples) -> dict[str, dict[str, float]]:
    """Scores of every output that varies."""
    truth = samples.q_next - samples.q
    truth[:, definition.angles] = wrap(truth[:, definition.angles])
    truth = torch.cat([truth[:, list(definition.moving)], samples.reward[:, None]], 1)
    rows = {}
    for column, name in enumerate(definition.outputs):
        kept = ~samples.terminated if name == REWARD else torch.ones_like(samples.terminated)
        size = float(truth[kept, column].std(correction=0))
        if size > 1e-9:
            off = found.mean[:, kept, column] - truth[kept, column]
            if column < len(definition.moving) and definition.moving[column] in definition.angles:
                off = wrap(off)
            off = off / size
            variance = (found.std[:, kept, column] / size).square()
            rows[name] = scored(off.mean(0), variance[0])
            if len(off) > 1:
                variance = variance + 1e-4
                densities = -0.5 * (off.square() / variance + (2 * math.pi * variance).log())
                rows[name]["density"] = float((densities.logsumexp(0) - math.log(len(off))).mean())
    if found.end is not None and bool(samples.terminated.any()):
        right = torch.where(samples.terminated, found.end, 1 - found.end)
        rows["end"] = {
            "error": float((right < 0.5).double().mean()),
            "density": float(right.clamp_min(1e-3).log().mean()),
        }
    return rows


def differs(a: Foretold, b: Foretold) -> bool:
    if a.mean.shape != b.mean.shape:
        return True
    size = a.mean.std(1, keepdim=True, correction=0).clamp_min(1e-12)
    apart = max(float(((x - y) / size).abs().max()) for x, y in ((a.mean, b.mean), (a.std, b.std)))
    ends = 0.0 if a.end is None or b.end is None else float((a.end - b.end).abs().max())
    return max(apart, ends) > SAME


def learned_without(
    mechanism: Mechanism, original: Any, samples: Samples
) -> tuple[EnvironmentDefinition, GaussianProcessModel]:
    definition = definition_of(original, mechanism.settings)
    with ExitStack() as stack:
        for patched in mechanism.patches:
            stack.enter_context(patch.object(*patched))
        return definition, gaussian_processes(definition, samples)


def rows_of(name: str, sizes: Sequence[int], seeds: Sequence[int], chosen: Sequence[str], every: bool) -> Iterator[Any]:
    """A row for each output, design and mechanism that changes the model, and one for each that does not."""
    original = PLANTS[name]()
    definition = definition_of(original, {})
    tests = steps_of(original, definition, UNSEEN, UNSEEN_SEED, spread=False)
    for size in sizes:
        for seed in seeds:
            samples = steps_of(original, definition, size, seed, spread=True)
            whole = gaussian_processes(definition, samples)
            before = foretold([whole], tests)
            scores = judged(definition, before, tests)
            where = {"plant": name, "n": size, "seed": seed}
            for mechanism in chosen:
                if not (every or MECHANISMS[mechanism].used(whole)):
                    yield {**where, "mechanism": mechanism, "output": "", "used": False, "changed": False}
                    continue
                begun = time.perf_counter()
                _, less = learned_without(MECHANISMS[mechanism], original, samples)
                after = foretold([less], tests)
                changed = differs(before, after)
                said = {**where, "mechanism": mechanism, "used": MECHANISMS[mechanism].used(whole), "changed": changed}
                yield from _compared(said, scores, judged(definition, after, tests), time.perf_counter() - begun)
            functions = whole.uncertain_functions
            if isinstance(functions, FunctionsOfSeveral) and size <= max(SIZES):
                mixed = judged(definition, foretold(functions.models, tests), tests)
                yield from _compared({**where, "mechanism": SEVERAL, "used": True, "changed": True}, mixed, scores, 0.0)


def _compared(said: dict[str, Any], with_: Any, without: Any, seconds: float) -> Iterator[dict[str, Any]]:
    if not said["changed"]:
        yield {**said, "output": ""}
        return
    for output, row in with_.items():
        other = without[output]
        ratio = (other["error"] + 1e-3) / (row["error"] + 1e-3)
        yield {
            **said, "output": output, "error": row["error"], "ratio": ratio, "density": row["density"],
            "gain": row["density"] - other["density"], "seconds": seconds,
        }  # fmt: skip


def table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line for each mechanism and plant that it changes, over outputs whose scores differ."""
    lines = ["| mechanism | plant | models changed | outputs | error without / with | gain | better, worse |"]
    lines.append("|" + "---|" * 7)
    for mechanism in dict.fromkeys(row["mechanism"] for row in rows):
        of = [row for row in rows if row["mechanism"] == mechanism]
        plants = list(dict.fromkeys(row["plant"] for row in of if row["changed"]))
        for plant in ["all", *plants]:
            here = [row for row in of if plant in ("all", row["plant"])]
            models = {(row["plant"], row["n"], row["seed"]): row["changed"] for row in here}
            moved = [r for r in here if r["changed"] and (abs(r["gain"]) > 1e-6 or abs(r["ratio"] - 1) > 1e-6)]
            line = f"| {mechanism} | {plant} | {sum(models.values())} of {len(models)} |"
            if moved:
                ratio = math.exp(np.mean([math.log(row["ratio"]) for row in moved]))
                gains = np.array([row["gain"] for row in moved])
                line += f" {len(moved)} | {ratio:.3f} | {gains.mean():+.3f} |"
                line += f" {(gains > 0.1).sum()}, {(gains < -0.1).sum()} |"
            lines.append(line)
    return lines


def ruled(name: str, seed: int, budget: int) -> dict[str, Any]:
    """An adaptive design, and the rounds in which each rule chose queries or reserved candidates."""
    original, counts = PLANTS[name](), Counter()

    def counted(called: str, rule: Any) -> Any:
        def wrapped(*arguments: Any) -> Any:
            found = rule(*arguments)
            counts[called] += found is not None and (not isinstance(found, tuple) or len(found) > 0)
            return found

        return wrapped

    spec = original.spec()
    spec = spec.model_copy(update={"design": spec.design.model_copy(update={"seed": seed})})
    with ExitStack() as stack:
        for rules in ("STEP_RULES", "ROLLOUT_RULES"):
            wrapped = tuple(counted(rule.__name__, rule) for rule in getattr(design, rules))
            stack.enter_context(patch.object(design, rules, wrapped))
        for reserving in ("ending", "highest"):
            stack.enter_context(patch.object(judging, reserving, counted(reserving, getattr(judging, reserving))))
        made, resets, kept = surrogym.Design(spec, budget=budget), 0, {}
        while (query := made.ask()) is not None:
            if query.coordinates:
                made.tell(query, original.step_from(np.array(query.coordinates), np.array(query.action)))
                continue
            if query.snapshot:
                original.restore(kept[query.snapshot])
            else:
                original.begin(seed=1_000 * seed + resets)
            resets, steps, names = resets + 1, [], []
            for action in query.actions:
                steps.append(original.act(np.array(action)))
                names.append(None)
                if steps[-1].terminated or steps[-1].truncated:
                    break
                if spec.snapshots:
                    names[-1] = f"{resets}-{len(steps)}"
                    kept[names[-1]] = original.save()
            made.tell(query, steps, names)
    return {"plant": name, "seed": seed, "phase": made.phase, "steps": made.steps, **counts}


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--plants", nargs="+", choices=PLANTS, default=list(PLANTS))
    made.add_argument("--mechanisms", nargs="+", choices=MECHANISMS, default=list(MECHANISMS))
    made.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    made.add_argument("--sizes", type=int, nargs="+", help="numbers of samples")
    made.add_argument("--all", action="store_true", help="mechanisms that a model does not use as well")
    made.add_argument("--many", action="store_true", help="models of hundreds of samples")
    made.add_argument("--rules", action="store_true", help="adaptive designs, and which rules chose their queries")
    made.add_argument("--name", default="ablation", help="of the JSON file")
    options = started(made)
    sizes, rows = options.sizes or (MANY if options.many else SIZES), []
    for plant in options.plants:
        begun = time.perf_counter()
        try:
            if options.rules:
                rows += (found := [ruled(plant, seed, BUDGET) for seed in options.seeds])
                print(*found, sep="\n")
            else:
                rows += rows_of(plant, sizes, options.seeds, options.mechanisms, options.all)
        except Exception as error:  # a plant whose packages are missing is left out
            print(f"{plant}: left out, {type(error).__name__}: {error}")
        write(options.out, options.name, {"rows": rows})
        print(f"{plant}: {time.perf_counter() - begun:.0f} s")
    if not options.rules:
        print("\n".join(table(rows)))


if __name__ == "__main__":
    main()
