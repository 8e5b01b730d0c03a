"""What it costs to find hyperparameters by maximum evidence, beside scikit-learn and GPyTorch in the same run.

Run by ``make bench``, one thread each. All search the same way: the same draws of a smooth function with small noise,
the same covariance, no priors, one start, logarithms within the same bounds, and SciPy's L-BFGS-B with the same
tolerances and number of iterations. The evidence that each has found is computed by ourselves, so a fit that is fast
and poor would be seen. The libraries' fits are timed in a process of their own, in turns with ours.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from unittest import mock

import numpy as np
import torch
from bench_predict import COMPARISON, QUICK, Row, measure, table
from common import parser, started, timed, write
from numpy.typing import NDArray
from owned import Child, installed

from surrogym_server.gp import FitOptions, Hyperparameters, fit
from surrogym_server.gp.kernel import covariance
from surrogym_server.gp.search import Evidence

SIZES, DRAWS = (10, 40, 125, 300), 4
LENGTHSCALES, NOISE = (2.0, 3.0, 4.0, 6.0, 8.0, 12.0), 1e-4  # of the function that is drawn
OURS, LIBRARIES = "Surrogym", {"scikit-learn": "scikit_learn", "GPyTorch": "gpytorch"}
WIDE = 1e4  # deviation of a prior that says nothing
OPTIONS = FitOptions(
    linear=False,
    quadratic=False,
    lengthscale_prior=(-0.5 * math.log(len(LENGTHSCALES)), WIDE),  # a start of 1 in six inputs, as of the signal
    signal_prior=(0.0, WIDE),
    noise_prior=(0.0, WIDE),
)
PRIORS = (len(LENGTHSCALES) + 2) * math.log(WIDE)  # what they take from the log evidence

Array = NDArray[np.float64]


def draw(points: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Inputs (n, 6) and a noisy function of them (n,), both standardised."""
    rng = np.random.default_rng(seed)
    x = torch.from_numpy(rng.normal(size=(points, len(LENGTHSCALES))))
    hyper = Hyperparameters(torch.tensor(LENGTHSCALES, dtype=torch.float64), 1.0, 0.0, 0.0, NOISE)
    k = covariance(hyper, x, x) + NOISE * torch.eye(points, dtype=torch.float64)
    y = torch.linalg.cholesky(k) @ torch.from_numpy(rng.normal(size=points))
    return (x - x.mean(0)) / x.std(0), (y - y.mean()) / y.std()


def searched(x: torch.Tensor, y: torch.Tensor) -> tuple[Array, int]:
    """What our fit finds, and after how many evaluations."""
    with mock.patch.object(Evidence, "__call__", autospec=True, side_effect=Evidence.__call__) as evaluation:
        return fit(x, y, OPTIONS).theta, evaluation.call_count


def fits(points: int, out: Path, seconds: float) -> Iterator[Row]:
    """A row for each that fits: what one of ``DRAWS`` fits takes, and the evidence that it finds."""
    draws = [draw(points, seed) for seed in range(DRAWS)]
    objectives = [Evidence(x, y, OPTIONS, None) for x, y in draws]
    with ExitStack() as stack:
        told = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "told.npz"
        np.savez(
            told,
            x=np.stack([x.numpy() for x, _ in draws]),
            y=np.stack([y.numpy() for _, y in draws]),
            start=np.exp(objectives[0].default_start),
            bounds=np.exp(np.stack([objectives[0].lower, objectives[0].upper], 1)),
            iterations=OPTIONS.max_iterations,
            constant=PRIORS,
        )
        subjects = {OURS: timed(lambda: [fit(x, y, OPTIONS) for x, y in draws])}
        found = {OURS: [searched(x, y) for x, y in draws]}
        for shown, name in LIBRARIES.items():
            subjects[shown] = stack.enter_context(Child(installed(out, name), "fit", name, str(told)))
            fitted = np.load(f"{told}.fitted.npz")
            found[shown] = list(zip(fitted["theta"], fitted["evaluations"].tolist(), strict=True))
        taken = measure(subjects, seconds)
    evidence = {
        name: np.array([PRIORS - objective(theta)[0] for objective, (theta, _) in zip(objectives, each, strict=True)])
        for name, each in found.items()
    }
    for name, each in found.items():
        evaluations = sum(count for _, count in each) / DRAWS
        yield {
            "n": points,
            "by": name,
            "a fit": taken[name] / DRAWS,
            "an evaluation": taken[name] / DRAWS / evaluations,
            "evaluations": evaluations,
            "log evidence": float(evidence[name].mean()),
            "at most above ours": float((evidence[name] - evidence[OURS]).max()),
        }


def main() -> None:
    options = started(parser(__doc__))
    seconds = QUICK if options.quick else COMPARISON
    rows = [row for points in SIZES for row in fits(points, options.out, seconds)]
    table(f"fit of one output, {len(LENGTHSCALES)} inputs, means of {DRAWS} draws", rows)
    write(options.out, "evidence", {"fits": rows})


if __name__ == "__main__":
    main()
