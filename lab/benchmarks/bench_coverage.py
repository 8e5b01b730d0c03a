"""Coverage of predictions one and ten steps ahead, on real episodes of the policies of a study.

Each run folder of a study has the database and the policy of one run. The policy acts in the original environment from
starts that were not used before. The run's last model predicts one window of each episode: its first step, and the
state after ten steps with the sum of their rewards. Predictions are along functions drawn as for a promise, with
uncertain hyperparameters, and with the noise that the design has confirmed. In the ten steps the policy acts in each
draw, because recorded actions answer the noise of the recorded episode.

An output counts where its errors exceed the tolerance: where the 90 % quantile of its errors over all seeds does. Then
all its predictions count. To count only those with large errors would select what was missed.

Run it after ``python -m surrogym_lab trust``::

    python lab/benchmarks/bench_coverage.py --study runs/trust
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import torch
from common import parser, started, write

from support.calibration import HORIZON, Array, Trajectories, outputs
from surrogym.demo.judging import episodes_of
from surrogym_lab.settings import StudySettings
from surrogym_sampler.original.actions import decode_actions
from surrogym_server.convert import stored_definition
from surrogym_server.environment.actions import model_actions
from surrogym_server.models.draws import function_draws
from surrogym_server.models.port import DynamicsModel
from surrogym_server.services.definitions import Definitions
from surrogym_server.services.models import load_model
from surrogym_server.storage.sql.storage import open_storage
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.terms import observe
from surrogym_trainer.evaluation.evaluator import EvaluationSettings, Trace, evaluate
from surrogym_trainer.policies.card import read_card
from surrogym_trainer.policies.files import load_policy
from surrogym_trainer.policies.predict import Predict

DRAWS, EPISODES, FIRST_SEED = 256, 60, 30_000
LEVEL = 0.9
HORIZONS = (1, HORIZON)


@dataclass(frozen=True)
class Known:
    """A run's last model, and the tolerances (O,) that it was judged by."""

    model: DynamicsModel
    tolerances: Array

    @classmethod
    def of(cls, database: Path, name: str) -> Known:
        storage = open_storage(f"sqlite:///{database}")
        try:
            definitions = Definitions(storage, lambda spec: stored_definition(EnvironmentSpec.model_validate(spec)))
            version = storage.models.list(name)[-1].version
            model = load_model(storage, definitions, storage.surrogates.get(name).id, version)
            return cls(model, np.array(storage.models.get(name, version).tolerances))
        finally:
            storage.close()


@dataclass(frozen=True)
class Draws:
    """Functions drawn from a model, in which a policy acts."""

    model: DynamicsModel
    paths: torch.Tensor  # (s, W)
    noise: torch.Generator | None  # of the process; None: not in this run
    predict: Predict
    spec: EnvironmentSpec

    def ahead(self, start: Array, steps: int) -> tuple[Array, Array]:
        """States (s, m, C) after a number of steps from each start (m, C), and the sums of rewards (s, m)."""
        draws, count = function_draws(self.model, DRAWS), len(self.paths)
        paths, q = self.paths.repeat_interleave(len(start), 0), torch.from_numpy(start).repeat(count, 1)
        paid = torch.zeros(len(q), dtype=torch.float64)
        for _ in range(steps):
            moved = draws.transition_along(
                paths, q, torch.from_numpy(self._act(q.numpy())), process=self._shock(len(q))
            )
            q, paid = moved.q_next, paid + moved.reward
        return q.numpy().reshape(count, len(start), -1), paid.numpy().reshape(count, -1)

    def _act(self, q: Array) -> Array:
        chosen = decode_actions(self.spec, self.predict(observe(self.spec, q).astype(np.float32)), len(q))
        return model_actions(self.model.definition, chosen)

    def _shock(self, count: int) -> torch.Tensor | None:
        if self.noise is None:
            return None
        return torch.randn(count, len(self.model.definition.moving), generator=self.noise, dtype=torch.float64)


def windows(traces: tuple[Trace, ...], seed: int) -> Trajectories | None:
    """One window of ``HORIZON`` steps of each episode, beginning anywhere in it; None if all episodes are shorter."""
    rng = np.random.default_rng(seed)
    long = [trace for trace in traces if len(trace.reward) >= HORIZON]
    if not long:
        return None
    begins = [int(rng.integers(len(trace.reward) - HORIZON + 1)) for trace in long]
    cut = [
        (t.coordinates[b : b + HORIZON + 1], t.action[b : b + HORIZON], t.reward[b : b + HORIZON])
        for t, b in zip(long, begins, strict=True)
    ]
    return Trajectories(*(np.stack(parts) for parts in zip(*cut, strict=True)))


def rows_of(run: Path, settings: StudySettings) -> Iterator[dict[str, Any]]:
    """One row for each horizon and output: its errors over the tolerance, and which lie in the 90 % interval."""
    policy, known = run / "policy.zip", Known.of(run / "surrogym.db", settings.task)
    card = read_card(policy)
    predict, fresh = load_policy(policy, card.algorithm), EvaluationSettings(episodes=EPISODES, first_seed=FIRST_SEED)
    real = windows(evaluate(predict, episodes_of(settings), fresh).traces, settings.seed)
    if real is None:
        return
    random = torch.Generator().manual_seed(settings.seed)
    size = function_draws(known.model, DRAWS).path_size
    paths = function_draws(known.model, DRAWS).draw(torch.randn(DRAWS, size, generator=random, dtype=torch.float64))
    fidelity = json.loads((run / "metrics.json").read_text(encoding="utf-8"))["fidelity"]
    noisy = any(output["noise"] > 0 for output in fidelity["outputs"])
    draws = Draws(known.model, paths, random if noisy else None, predict, settings.spec())
    for steps in HORIZONS:
        drawn, truth = outputs(
            known.model, *draws.ahead(real.q[:, 0], steps), real.q[:, steps], real.reward[:, :steps].sum(1)
        )
        low, middle, high = np.quantile(drawn, [(1 - LEVEL) / 2, 0.5, (1 + LEVEL) / 2], axis=0)
        errors = np.abs(truth - middle) / (known.tolerances * np.sqrt(steps))
        inside = (truth >= low) & (truth <= high)
        for column, output in enumerate(known.model.definition.outputs):
            case = {"task": settings.task, "seed": settings.seed, "noisy": noisy, "steps": steps, "output": output}
            yield case | {"errors": errors[:, column].tolist(), "inside": inside[:, column].tolist()}


def table(rows: list[dict[str, Any]]) -> str:
    """A line for each output that counts, over the seeds of a task."""
    lines = [
        "| task | steps | output | 90 % quantile of errors / tolerance | in the 90 % interval "
        "| or within the tolerance | by seed |",
        "|---|---|---|---|---|---|---|",
    ]
    cases = dict.fromkeys((row["task"], row["steps"], row["output"]) for row in rows)
    counted = [line for case in cases if (line := _line(case, rows))]
    return "\n".join([*lines, *counted, "", _left_out(rows, len(counted), len(cases))])


def _line(case: tuple[str, int, str], rows: list[dict[str, Any]]) -> str | None:
    chosen = [row for row in rows if (row["task"], row["steps"], row["output"]) == case]
    errors = np.array([row["errors"] for row in chosen])
    inside = np.array([row["inside"] for row in chosen])
    quantile = np.quantile(errors, LEVEL)
    if quantile <= 1:
        return None
    right = inside | (errors <= 1)
    seeds = ", ".join(f"{100 * share:.0f}" for share in right.mean(1))
    task, steps, output = case
    shares = f"{100 * inside.mean():.0f} % | {100 * right.mean():.0f} %"
    return f"| {task} | {steps} | {output} | {quantile:.2f} | {shares} | {seeds} |"


def _left_out(rows: list[dict[str, Any]], counted: int, of: int) -> str:
    tasks = len({row["task"] for row in rows})
    return f"{counted} of {of} outputs and horizons of {tasks} tasks count. The others err within the tolerance."


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--study", type=Path, required=True, help="folder that python -m surrogym_lab wrote")
    options = started(made)
    rows: list[dict[str, Any]] = []
    for run in sorted((options.study / "runs").iterdir()):
        if not (run / "metrics.json").exists():
            continue
        task, _, seed = run.name.partition("-default-seed")
        rows += rows_of(run, StudySettings(task, int(seed)))
        print(run.name)
    print(table(rows))
    write(options.out, "coverage", {"rows": rows})


if __name__ == "__main__":
    main()
