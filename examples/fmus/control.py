"""A controller for a plant in an FMU, from a few of its steps, beside one that was trained in the plant itself.

python control.py TwoTanks
python control.py InvertedPendulum --baseline 400000    # also train in the plant, for this many steps

The package pythonfmu builds the FMU: pip install -e ".[all,fmu]" pythonfmu
Without -e, --baseline does not work, because it needs the package surrogym_lab, which is in a clone only.
"""

import argparse
import importlib
import importlib.util
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import surrogym
from surrogym_sampler import original
from surrogym_sampler.original.describing import describe
from surrogym_sampler.original.episodes import open_episode
from surrogym_shared.logs.rewards import declared_reward
from surrogym_shared.spec import DeclaredReward, EnvironmentSpec, Quantity, RewardTerm, Term, Uniform
from surrogym_trainer.evaluation.evaluator import EvaluationSettings, evaluate
from surrogym_trainer.policies import load_policy
from surrogym_trainer.training import TrainSettings, train

FOLDER = Path(__file__).parent
SCRIPTS = {"TwoTanks": "two_tanks", "InvertedPendulum": "inverted_pendulum"}


def squared(weight: float, term: Term | None = None, action: float | None = None) -> RewardTerm:
    quantity = Quantity(term=term, action=() if action is None else (action,))
    return RewardTerm(weight=-weight, shape="square", of=(quantity,))


GOALS = {  # cost of a step, and where episodes start
    "TwoTanks": (
        (squared(1.0, Term.linear(lower=1) + Term.constant(-0.4)), squared(0.01, Term.constant(-0.5), 1.0)),
        {"upper": Uniform(low=0.05, high=0.6), "lower": Uniform(low=0.05, high=0.6)},
    ),
    "InvertedPendulum": (
        (
            RewardTerm(weight=2.0, shape="linear", of=(Quantity(term=Term.cos(angle=1) + Term.constant(-1)),)),
            squared(0.1, Term.linear(speed=1)),
            squared(0.001, None, 1.0),
        ),
        {"angle": Uniform(low=-0.3, high=0.3), "speed": Uniform(low=-0.3, high=0.3)},
    ),
}


def built(name: str, folder: Path) -> Path:
    """Build the FMU of a plant."""
    script = FOLDER / f"{SCRIPTS[name]}.py"
    options = ["--handle-state", "--serialize-state"]
    command = [sys.executable, "-m", "pythonfmu", "build", "-f", str(script), "-d", str(folder), *options]
    subprocess.run(command, check=True)
    return folder / f"{name}.fmu"


class Plant:
    """The program inside the FMU, stepped without the FMU. Many run at once, so a training in the plant is faster."""

    parallel = True

    def __init__(self, name: str, spec: EnvironmentSpec) -> None:
        sys.path.insert(0, str(FOLDER))
        self._plant = getattr(importlib.import_module(SCRIPTS[name]), name)(instance_name=name)
        self._spec, self._input = spec, self._plant.vars[0].name
        self._seconds = self._plant.default_experiment.step_size

    def spec(self) -> EnvironmentSpec:
        return self._spec

    def step_from(self, coordinates: np.ndarray, action: np.ndarray) -> surrogym.RealStep:
        names = self._spec.coordinate_names
        for name, value in zip(names, coordinates, strict=True):
            setattr(self._plant, name, float(value))
        setattr(self._plant, self._input, float(action[0]))
        self._plant.do_step(0.0, self._seconds)
        after = np.array([getattr(self._plant, name) for name in names])
        rows = (np.atleast_2d(row) for row in (coordinates, action, after))
        reward = declared_reward(self._spec, *rows, np.zeros(1, dtype=bool))
        return surrogym.RealStep(coordinates, action, after, reward=float(reward[0]))

    def close(self) -> None:
        pass


def judged(policy: Path, environment: str, spec: EnvironmentSpec, episodes: int) -> float:
    """Mean return in the FMU."""
    factory = lambda: open_episode(environment, spec, lambda: original.make(environment, spec=spec))  # noqa: E731
    returns = evaluate(load_policy(policy), factory, EvaluationSettings(episodes=episodes)).returns
    print(f"  {episodes} episodes in the FMU: mean {returns.mean():.4f}, worst {returns.min():.4f}")
    return float(returns.mean())


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("plant", choices=SCRIPTS)
    parser.add_argument("--budget", type=int, default=30, help="real steps of the design")
    parser.add_argument("--steps", type=int, default=None, help="virtual steps of the training")
    parser.add_argument("--baseline", type=int, default=0, help="real steps of a training in the plant itself")
    parser.add_argument("--algorithm", default="FASTPPO", help="of that training, such as PPO")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if options.baseline and importlib.util.find_spec("surrogym_lab") is None:
        parser.error('--baseline needs surrogym_lab, which is in a clone only: there, pip install -e ".[all,fmu]"')
    terms, start = GOALS[options.plant]
    with tempfile.TemporaryDirectory() as folder:
        environment = f"fmu:{built(options.plant, Path(folder))}"
        description = describe(environment)
        print(*description.words(), sep="\n")
        reward = DeclaredReward(kind="declared", timing="after", terms=terms)
        spec = description.spec.model_copy(update={"reward": reward, "start": start})

        machine = original.make(environment, spec=spec, budget=options.budget, seed=options.seed)
        design = surrogym.Design(machine.spec())
        while (query := design.ask()) is not None:
            design.tell(query, machine.step_from(np.array(query.coordinates), np.array(query.action)))
        machine.close()
        print(f"surrogate: {design.phase} after {design.steps} real steps", design.fidelity["confidence_index"])
        policy = Path(folder, "policy.zip")
        trained = train(design.surrogate(), policy, TrainSettings(total_steps=options.steps, seed=options.seed))
        print(f"policy from the surrogate: {trained.algorithm}, {trained.virtual_steps} virtual steps")
        ours = judged(policy, environment, spec, options.episodes)

        if options.baseline:
            from surrogym_lab.original_port import OriginalPort  # in a clone only

            port = OriginalPort(spec, lambda: open_episode("own", spec, lambda: Plant(options.plant, spec)))
            settings = TrainSettings(options.algorithm, options.baseline, seed=options.seed)
            trained = train(port, Path(folder, "baseline.zip"), settings)
            print(f"policy from the plant itself: {trained.algorithm}, {port.steps} real steps")
            theirs = judged(Path(folder, "baseline.zip"), environment, spec, options.episodes)
            print(f"from the surrogate {100 * (ours - theirs) / abs(theirs):+.2f} % of the plant's return")


if __name__ == "__main__":
    main()
