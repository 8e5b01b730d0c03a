"""What a prediction costs, beside scikit-learn, GPyTorch and the bare matrix products in the same run.

Run by ``make bench``, on one thread but where it says two. Subjects take turns, so that what else the machine does
hits all alike; read the ratios, not the milliseconds. "Products" are those that a prediction can't do without, in
blocks of the same size: exponents, polynomial parts, means, and in place of each triangular solve the product with a
matrix of the same size. The libraries are installed by name into an environment of their own, and their calls are
timed in a process there.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import torch
from common import Call, Subject, parser, slopes, started, timed, write
from owned import Child, installed

from support.models import learn
from support.real_steps import random_steps
from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.gp import Hyperparameters, Output, Posterior, Serving, condition
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.tensors import in_blocks
from surrogym_server.virtual import VirtualSettings, create, in_fastest_form, reset, step

POINTS, OUTPUTS, INPUTS = 125, 4, 4
BATCHES = (1, 1_024, 8_192)
LANES = (1, 4, 16, 64, 256, 1_024, 4_096)
SIZES = (10, 30, 100, 300, 1_000, 2_000)
PARTICLE_LANES, PARTICLES, SAMPLES = 64, (10, 100, 1_000, 4_000), 50
LENGTHSCALE, NOISE = 1.5, 1e-4
LIBRARIES = {"scikit-learn": "scikit_learn", "GPyTorch": "gpytorch", "GPyTorch, fast_pred_var": "gpytorch_fast"}
COMPARISON, QUICK, TURN, LEAST_ROUNDS = 5.0, 0.5, 0.05, 2  # seconds; turns of each subject

Row = dict[str, Any]


def measure(subjects: Mapping[str, Subject], seconds: float) -> dict[str, float]:
    """Median milliseconds of each. They take turns, each of ``TURN`` seconds, and one call at least."""
    counts = {name: max(1, int(TURN / min(subject(2)))) for name, subject in subjects.items()}
    taken: dict[str, list[float]] = {name: [] for name in subjects}
    rounds, end = 0, time.perf_counter() + seconds
    while rounds < LEAST_ROUNDS or time.perf_counter() < end:
        for name, subject in subjects.items():
            taken[name] += subject(counts[name])
        rounds += 1
    return {name: 1e3 * statistics.median(each) for name, each in taken.items()}


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
    z = torch.rand(rows, serving.exponents.shape[0], dtype=torch.float64, device=serving.exponents.device)

    def block(z: torch.Tensor) -> tuple[torch.Tensor, ...]:
        k = z @ serving.exponents
        mean = z @ serving.polynomials + k @ serving.weights
        for process in (serving.processes[c] for c in wanted if c in serving.processes):
            covariance = k[:, process.span]
            if process.mirror is not None:  # the covariances with the mirror images are added to the others
                covariance, _ = covariance.chunk(2, 1)
            if process.polynomial is not None:
                covariance.addmm_(z, process.polynomial)
            covariance @ process.factor
        return (mean,)

    return lambda: in_blocks(serving.rows, block, z)


def predictions(batch: int, out: Path, seconds: float) -> Row:
    posteriors = processes(POINTS)
    serving = compiled(posteriors)
    at = torch.from_numpy(np.random.default_rng(1).normal(size=(batch, INPUTS)))

    def ours() -> tuple[torch.Tensor, torch.Tensor]:
        return serving.mean_and_std(at, range(OUTPUTS))

    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        told = folder / "told.npz"
        np.savez(
            told,
            x=posteriors[0].x.numpy(),
            y=np.stack([p.y.numpy() for p in posteriors]),
            at=at.numpy(),
            lengthscale=np.full(INPUTS, LENGTHSCALE),
            noise=NOISE,
        )
        subjects = {"Surrogym": timed(ours), "products": timed(products(serving, batch, range(OUTPUTS)))}
        for shown, name in LIBRARIES.items():
            python = installed(out, name.removesuffix("_fast"))
            subjects[shown] = stack.enter_context(Child(python, "predict", name, str(told)))
            if name != "gpytorch_fast":  # it approximates
                check(shown, ours(), np.load(f"{told}.predicted.npz"))
        return {"batch": batch, **measure(subjects, seconds)}


def check(name: str, ours: tuple[torch.Tensor, torch.Tensor], theirs: Mapping[str, np.ndarray]) -> None:
    """All predict the same."""
    for what, value, tolerance in zip(("mean", "deviation"), ours, ((0, 1e-5), (1e-3, 1e-4)), strict=True):
        relative, absolute = tolerance
        torch.testing.assert_close(
            value, torch.from_numpy(theirs[what]), rtol=relative, atol=absolute, msg=lambda m: f"{name}: {m}"
        )


def growth(points: int, seconds: float) -> Row:
    """1,024 predictions of four outputs, mean alone and with variance; one more sample; a factorisation anew."""
    posteriors = processes(points)
    serving = compiled(posteriors)
    at = torch.from_numpy(np.random.default_rng(1).normal(size=(1_024, INPUTS)))
    one = posteriors[0]
    subjects = {
        "mean": timed(lambda: serving.mean(at)),
        "mean, variance": timed(lambda: serving.mean_and_std(at, range(OUTPUTS))),
        "products": timed(products(serving, len(at), range(OUTPUTS))),
        "extend": timed(lambda: one.extend(at[0], at[0, 0])),
        "factorise": timed(lambda: condition(one.hyper, one.x, one.y)),
    }
    return {"n": points, **measure(subjects, seconds)}


def pendulum_model() -> GaussianProcessModel:
    return learn(definition_from_spec(pendulum()), random_steps(pendulum(), SAMPLES, seed=0)).model


def stepping(model: GaussianProcessModel, lanes: int, **chosen: Any) -> Call:
    """Steps in the form that a session of this model takes, unless ``compiled`` is given."""
    settings = VirtualSettings(lanes, **chosen)
    settings = settings if "compiled" in chosen else in_fastest_form(settings, model)
    state, _ = reset(model.definition, settings, create(model.definition, settings, 0))
    u = np.random.default_rng(0).uniform(-2, 2, (lanes, 1))
    return lambda: step(model, settings, state, u)


def steps(model: GaussianProcessModel, lanes: int, seconds: float) -> Row:
    subjects = {"AUR-D": timed(stepping(model, lanes)), "AUR-D, penalty": timed(stepping(model, lanes, penalty=3.0))}
    made = measure(subjects, seconds)
    return {"N": lanes, **made, "AUR-D, us a lane": 1e3 * made["AUR-D"] / lanes}


def particles(model: GaussianProcessModel, count: int, seconds: float) -> Row:
    stages = [group.serving for group in model._predictor._groups if group]
    bare = [products(s, PARTICLE_LANES * count, list(s.processes)) for s in stages]
    subjects = {
        "AUR-P": timed(stepping(model, PARTICLE_LANES, particles=count, **AUR_P)),
        "in torch": timed(stepping(model, PARTICLE_LANES, particles=count, compiled=False, **AUR_P)),
        "products": timed(lambda: [call() for call in bare]),
    }
    made = measure(subjects, seconds)
    return {"lanes x particles": f"{PARTICLE_LANES} x {count}", **made, "steps a second": 1e3 / made["AUR-P"]}


AUR_P = {"variant": "probabilistic", "penalty": 3.0}


def two_threads(model: GaussianProcessModel, seconds: float) -> Iterator[Row]:
    """Large work on one thread of torch and on two, which need two cores that nothing else uses."""
    serving = compiled(processes(POINTS))
    at = torch.from_numpy(np.random.default_rng(1).normal(size=(8_192, INPUTS)))
    for what, call in {
        "AUR-D, N=1,024": stepping(model, 1_024),
        "AUR-D, N=4,096": stepping(model, 4_096),
        "AUR-P, 64 x 1,000": stepping(model, PARTICLE_LANES, particles=1_000, **AUR_P),
        "mean, variance, 8,192": lambda: serving.mean_and_std(at, range(OUTPUTS)),
    }.items():
        made = measure({f"{count} threads": threaded(count, call) for count in (1, 2)}, seconds)
        yield {"what": what, **made, "1 over 2": made["1 threads"] / made["2 threads"]}


def threaded(count: int, call: Call) -> Subject:
    """With so many threads of torch for its turns, and one afterwards."""

    def calls(wanted: int) -> list[float]:
        torch.set_num_threads(count)
        try:
            return timed(call)(wanted)
        finally:
            torch.set_num_threads(1)

    return calls


def table(title: str, rows: Sequence[Row]) -> None:
    print(f"\n{title} (ms, median)")
    widths = [max(10, len(name)) for name in rows[0]]
    for row in (list(rows[0]), *(row.values() for row in rows)):
        shown = [f"{v:.3f}" if isinstance(v, float) else str(v) for v in row]
        print("  ".join(text.rjust(width) for text, width in zip(shown, widths, strict=True)))


def main() -> None:
    options = started(parser(__doc__))
    seconds = QUICK if options.quick else COMPARISON
    model, report = pendulum_model(), {}
    parts: dict[str, Callable[[], Iterator[Row]]] = {
        f"mean and variance, n={POINTS}, {OUTPUTS} outputs": lambda: (
            predictions(batch, options.out, seconds) for batch in BATCHES
        ),
        f"AUR-P step, Pendulum, n={SAMPLES}": lambda: (particles(model, count, seconds) for count in PARTICLES),
        f"AUR-D step, Pendulum, n={SAMPLES}": lambda: (steps(model, lanes, seconds) for lanes in LANES),
        f"1,024 predictions of {OUTPUTS} outputs": lambda: (growth(points, seconds) for points in SIZES),
        "threads": lambda: two_threads(model, seconds),
    }
    for title, rows in parts.items():
        report[title] = list(rows())
        table(title, report[title])
    grown = report[f"1,024 predictions of {OUTPUTS} outputs"]
    report["slopes of n"] = {name: slopes(SIZES, [row[name] for row in grown]) for name in grown[0] if name != "n"}
    print("\ntime grows from each n to the next by the power")
    for name, found in report["slopes of n"].items():
        print(f"{name:>16}  " + "  ".join(f"{slope:5.2f}" for slope in found))
    write(options.out, "predict", report)


if __name__ == "__main__":
    main()
