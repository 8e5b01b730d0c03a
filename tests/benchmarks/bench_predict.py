"""What a prediction costs, beside scikit-learn, GPyTorch and the bare matrix products in the same run.

Run by ``make bench``, on one thread, unless told otherwise. Subjects take turns, so that what else the machine does
hits all alike; read the ratios, not the milliseconds. "Products" are those that a prediction can't do without, in
blocks of the same size: exponents, polynomial parts, means, and in place of each triangular solve the product with a
matrix of the same size.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
import torch
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel
from threadpoolctl import threadpool_limits

from support.real_steps import random_steps
from surrogym_client.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.gp import Hyperparameters, Output, Posterior, Serving, condition, in_blocks
from surrogym_server.surrogate.learn import learn
from surrogym_server.surrogate.model import SurrogateModel
from surrogym_server.virtual import VirtualSettings, create, reset, step

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # of torch.jit, at import
    import gpytorch

POINTS, OUTPUTS, INPUTS = 125, 4, 4
BATCHES = (1, 1_024, 8_192)
LANES = (1, 4, 16, 64, 256, 1_024, 4_096)
SIZES = (10, 30, 100, 300, 1_000, 2_000)
PARTICLE_LANES, PARTICLES, SAMPLES = 64, (10, 100, 1_000, 4_000), 50
LENGTHSCALE, NOISE = 1.5, 1e-4
COMPARISON, TURN = 5.0, 0.05  # seconds

Call = Callable[[], Any]
Row = dict[str, Any]


def measure(subjects: dict[str, Call]) -> dict[str, float]:
    """Median milliseconds of each. They take turns, each of ``TURN`` seconds, and one call at least."""
    taken: dict[str, list[float]] = {name: [] for name in subjects}
    for call in subjects.values():
        call()
    end = time.perf_counter() + COMPARISON
    while time.perf_counter() < end:
        for name, call in subjects.items():
            turn = time.perf_counter()
            while (start := time.perf_counter()) - turn < TURN:
                call()
                taken[name].append(time.perf_counter() - start)
    return {name: 1e3 * statistics.median(seconds) for name, seconds in taken.items()}


def processes(points: int) -> list[Posterior]:
    """Four smooth functions of four inputs, under hyperparameters that every library is told."""
    rng = np.random.default_rng(0)
    x = torch.from_numpy(rng.normal(size=(points, INPUTS)))
    hyper = Hyperparameters(torch.full((INPUTS,), LENGTHSCALE, dtype=torch.float64), 1.0, 0.0, 0.0, NOISE)
    return [condition(hyper, x, torch.sin(x[:, i]) + 0.3 * x[:, i - 1]) for i in range(OUTPUTS)]


def compiled(posteriors: Sequence[Posterior]) -> Serving:
    outputs = [Output(i, p, tuple(range(INPUTS))) for i, p in enumerate(posteriors)]
    return Serving.of(outputs, len(outputs), INPUTS)


def products(serving: Serving, rows: int, wanted: Sequence[int]) -> Call:
    """The matrix products of ``rows`` predictions and of the variances of the columns ``wanted``, and nothing else."""
    z = torch.rand(rows, serving.exponents.shape[0], dtype=torch.float64)

    def block(z: torch.Tensor) -> tuple[torch.Tensor, ...]:
        k = z @ serving.exponents
        mean = z @ serving.polynomials + k @ serving.weights
        for process in (serving.processes[c] for c in wanted if c in serving.processes):
            covariance = k[:, process.span]
            if process.polynomial is not None:
                covariance.addmm_(z, process.polynomial)
            covariance @ process.factor
        return (mean,)

    return lambda: in_blocks(serving.rows, block, z)


def scikit_learn(posteriors: Sequence[Posterior], at: np.ndarray) -> Call:
    kernel = ConstantKernel(1.0, "fixed") * RBF([LENGTHSCALE] * INPUTS, "fixed")
    fitted = [GaussianProcessRegressor(kernel, alpha=NOISE).fit(p.x.numpy(), p.y.numpy()) for p in posteriors]
    return lambda: [regressor.predict(at, return_std=True) for regressor in fitted]


class BatchOfProcesses(gpytorch.models.ExactGP):
    """All outputs as one batch of independent processes, as GPyTorch recommends."""

    def __init__(self, posteriors: Sequence[Posterior]) -> None:
        batch = torch.Size([len(posteriors)])
        likelihood = gpytorch.likelihoods.GaussianLikelihood(batch_shape=batch)
        likelihood.noise = NOISE
        x = torch.stack([p.x for p in posteriors])
        super().__init__(x, torch.stack([p.y for p in posteriors]), likelihood)
        self.mean_module = gpytorch.means.ZeroMean(batch_shape=batch)
        rbf = gpytorch.kernels.RBFKernel(ard_num_dims=INPUTS, batch_shape=batch)
        self.covar_module = gpytorch.kernels.ScaleKernel(rbf, batch_shape=batch)
        self.covar_module.outputscale, rbf.lengthscale = 1.0, LENGTHSCALE
        self.double()
        self.eval()

    def forward(self, x: torch.Tensor) -> gpytorch.distributions.MultivariateNormal:
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))


def gpytorch_prediction(posteriors: Sequence[Posterior], at: torch.Tensor, fast_variance: bool) -> Call:
    model, repeated = BatchOfProcesses(posteriors), at.expand(OUTPUTS, *at.shape)

    def predict() -> tuple[torch.Tensor, torch.Tensor]:
        with torch.no_grad(), gpytorch.settings.fast_pred_var(fast_variance):
            predicted = model(repeated)
            return predicted.mean, predicted.variance

    return predict


def predictions(batch: int) -> Row:
    posteriors = processes(POINTS)
    serving = compiled(posteriors)
    at = torch.from_numpy(np.random.default_rng(1).normal(size=(batch, INPUTS)))
    subjects = {
        "Surrogym": lambda: serving.mean_and_deviation(at, range(OUTPUTS)),
        "products": products(serving, batch, range(OUTPUTS)),
        "scikit-learn": scikit_learn(posteriors, at.numpy()),
        "GPyTorch": gpytorch_prediction(posteriors, at, False),
        "GPyTorch, fast_pred_var": gpytorch_prediction(posteriors, at, True),
    }
    check(subjects)
    return {"batch": batch, **measure(subjects)}


def check(subjects: dict[str, Call]) -> None:
    """All predict the same."""
    mean, deviation = subjects["Surrogym"]()
    for name, (theirs, spread) in {
        "scikit-learn": tuple(torch.tensor(np.stack(a, -1)) for a in zip(*subjects["scikit-learn"](), strict=True)),
        "GPyTorch": tuple(t.T for t in subjects["GPyTorch"]()),
    }.items():
        spread = spread if name == "scikit-learn" else spread.sqrt()
        torch.testing.assert_close(mean, theirs, rtol=0, atol=1e-5)
        torch.testing.assert_close(deviation, spread, rtol=1e-3, atol=1e-4)


def growth(points: int) -> Row:
    """1,024 predictions of four outputs, mean alone and with variance."""
    serving = compiled(processes(points))
    at = torch.from_numpy(np.random.default_rng(1).normal(size=(1_024, INPUTS)))
    subjects = {
        "mean": lambda: serving.mean(at),
        "mean, variance": lambda: serving.mean_and_deviation(at, range(OUTPUTS)),
        "products": products(serving, len(at), range(OUTPUTS)),
    }
    return {"n": points, **measure(subjects)}


def pendulum_model() -> SurrogateModel:
    return learn(definition_from_spec(pendulum()), random_steps(pendulum(), SAMPLES, seed=0)).model


def stepping(model: SurrogateModel, lanes: int, **chosen: Any) -> Call:
    settings = VirtualSettings(lanes, **chosen)
    state, _ = reset(model.definition, settings, create(model.definition, settings, 0))
    u = np.random.default_rng(0).uniform(-2, 2, (lanes, 1))
    return lambda: step(model, settings, state, u)


def steps(model: SurrogateModel, lanes: int) -> Row:
    subjects = {"AUR-D": stepping(model, lanes), "AUR-D, penalty": stepping(model, lanes, penalty=3.0)}
    made = measure(subjects)
    return {"N": lanes, **made, "AUR-D, us a lane": 1e3 * made["AUR-D"] / lanes}


def particles(model: SurrogateModel, count: int) -> Row:
    shape = {"variant": "probabilistic", "particles": count, "penalty": 3.0}
    stages = [stage.serving for stage in model._stages if stage is not None]
    bare = [products(s, PARTICLE_LANES * count, list(s.processes)) for s in stages]
    subjects = {
        "AUR-P": stepping(model, PARTICLE_LANES, **shape),
        "products": lambda: [call() for call in bare],
    }
    made = measure(subjects)
    return {"lanes x particles": f"{PARTICLE_LANES} x {count}", **made, "steps a second": 1e3 / made["AUR-P"]}


def table(title: str, rows: Sequence[Row]) -> None:
    print(f"\n{title} (ms, median)")
    widths = [max(10, len(name)) for name in rows[0]]
    for row in (list(rows[0]), *(row.values() for row in rows)):
        shown = [f"{v:.3f}" if isinstance(v, float) else str(v) for v in row]
        print("  ".join(text.rjust(width) for text, width in zip(shown, widths, strict=True)))


def machine() -> Row:
    return {
        "cores": os.cpu_count(),
        "load": os.getloadavg(),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("build/benchmarks"), help="folder of the JSON file")
    parser.add_argument("--threads", type=int, default=1, help="of one torch operation")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    threadpool_limits(options.threads, user_api="blas")  # scikit-learn's
    model, report = pendulum_model(), {"machine": machine(), "threads": options.threads}
    for title, rows in {
        f"mean and variance, n={POINTS}, {OUTPUTS} outputs": (predictions(batch) for batch in BATCHES),
        f"AUR-P step, Pendulum, n={SAMPLES}": (particles(model, count) for count in PARTICLES),
        f"AUR-D step, Pendulum, n={SAMPLES}": (steps(model, lanes) for lanes in LANES),
        f"1,024 predictions of {OUTPUTS} outputs": (growth(points) for points in SIZES),
    }.items():
        report[title] = list(rows)
        table(title, report[title])
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "predict.json").write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
