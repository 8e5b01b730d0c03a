"""Learn, train and evaluate an environment with a past, in one process, for several seeds.

python past.py dead_time     # beside a Smith predictor that is tuned on the true plant
python past.py hidden_speed
python past.py dead_time --changes 3 --actions 8     # with more lags than the plant needs
"""

import argparse
import itertools
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
from dead_time import SmithPredictor, Vessel
from hidden_speed import AngleAlone

import surrogym
from surrogym_sampler.original.episodes import RolloutEpisode
from surrogym_sampler.original.rollouts import answering
from surrogym_trainer.evaluation.evaluator import EvaluationSettings, evaluate
from surrogym_trainer.policies import load_policy
from surrogym_trainer.training import TrainSettings, train
from surrogym_trainer.training.settings import DRAWS, FUNCTIONS

ENVIRONMENTS = {"dead_time": Vessel, "hidden_speed": AngleAlone}
TUNING_SEEDS = range(50)
GAINS = np.linspace(0.5, 5.0, 10), np.linspace(0.0, 3.0, 13)  # proportional, derivative
TESTED = EvaluationSettings(episodes=100)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("environment", choices=ENVIRONMENTS)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--budget", type=int, default=60, help="most real steps of a design")
    parser.add_argument("--steps", type=int, help="virtual steps of a training")
    parser.add_argument("--changes", type=int, help="earlier changes of a coordinate that are declared")
    parser.add_argument("--actions", type=int, help="earlier actions that are declared")
    options = parser.parse_args()
    declared = {name: n for name in ("changes", "actions") if (n := getattr(options, name)) is not None}
    if options.environment == "dead_time":
        print(smith_line())
    for seed in options.seeds:
        print(learned(partial(ENVIRONMENTS[options.environment], **declared), seed, options), flush=True)


def learned(kind, seed, options):
    """One line about the policy of one seed."""
    machine = answering(kind())
    spec = machine.spec().model_copy(update={"design": surrogym.DesignSettings(seed=seed)})
    design = surrogym.Design(spec, budget=options.budget)
    resets = 0
    while (query := design.ask()) is not None:
        machine.begin(seed=1_000 * seed + resets)
        design.tell(query, [machine.act(np.array(action)) for action in query.actions])
        resets += 1
    session = {} if design.phase == "ready" else {"session": DRAWS, "judge": FUNCTIONS}
    with tempfile.TemporaryDirectory() as folder:
        settings = TrainSettings(seed=seed, total_steps=options.steps, **session)
        found = train(design.surrogate(), Path(folder) / "policy.zip", settings)
        policy = load_policy(found.path, found.algorithm)
        result = evaluate(policy, lambda: RolloutEpisode(answering(kind())), TESTED)
    success = "" if result.success is None else f", upright in {int(result.success.sum())} of {len(result.success)}"
    chosen = design.surrogate().model.transitions[0].feature_map.history
    looks_back = "all declared lags" if chosen is None else f"{chosen} steps"
    return (
        f"seed {seed}: {design.steps} real steps in {resets} rollouts, {design.phase}, looks back {looks_back}, "
        f"mean return {result.returns.mean():.4g}, worst {result.returns.min():.4g}{success}"
    )


def smith_line():
    """One line about the Smith predictor with the best of many gains."""
    tuned = max(itertools.product(*GAINS), key=lambda gains: smith_returns(*gains, TUNING_SEEDS).mean())
    first = TESTED.first_seed
    returns = smith_returns(*tuned, range(first, first + TESTED.episodes))
    return f"Smith predictor, gains {tuned[0]:.2g} and {tuned[1]:.2g}: mean return {returns.mean():.4g}"


def smith_returns(proportional, derivative, seeds):
    """Return of an episode from each seed, (n,)."""
    vessel, controller = Vessel(), SmithPredictor(proportional, derivative)
    return np.array([smith_return(vessel, controller, seed) for seed in seeds])


def smith_return(vessel, controller, seed):
    level, _ = vessel.reset(seed=seed)
    controller.begin()
    total = 0.0
    for _ in range(50):
        level, reward, *_ = vessel.step([controller.act(level)])
        total += reward
    return total


if __name__ == "__main__":
    main()
