"""What the benchmarks of structure share: the case of one output, its scores, and adaptive designs."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any

import numpy as np
import torch
from torch import Tensor

from support.real_steps import arrays, join
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition, wrap
from surrogym_server.environment.features import encode, features, leading
from surrogym_server.environment.samples import Samples, increments
from surrogym_server.gp import FitOptions, Fitted, Reflection, condition, fit
from surrogym_server.gp.kernel import Hyperparameters
from surrogym_server.gp.search import Evidence, minimum
from surrogym_server.models.gaussian_process.censoring import usable
from surrogym_server.models.gaussian_process.feature_maps import reflection
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.sampling.design import advance, initial_queries
from surrogym_server.sampling.latin_hypercube import going_on, latin_hypercube, random_points
from surrogym_server.sampling.state import DesignState, Request
from surrogym_shared.spec import REWARD, Design, Reward

UNSEEN, UNSEEN_SEED, BUDGET = 500, 99, 100
CHOSEN = 3.0  # nats of evidence by which a structure other than fewer inputs must win
AS_IT_IS = "as it is"
FLOOR = 0.01  # of the output's deviation on unseen steps
SETTINGS = {
    "reward_jumps": False,
    "reward_peaks": False,
    "drop_inputs": False,
}  # the reward is its process, so that it can be fitted again


def scored(off: Tensor, variance: Tensor) -> dict[str, float]:
    """Scores of errors (m,) with predicted variances (m,), both in deviations of the output."""
    variance = variance + FLOOR**2
    density = -0.5 * (off.square() / variance + (2 * math.pi * variance).log())
    covered = (off.abs() <= NormalDist().inv_cdf(0.95) * variance.sqrt()).double()
    return {
        "error": float(off.square().mean().sqrt()),
        "density": float(density.mean()),
        "coverage": float(covered.mean()),
    }


@dataclass(frozen=True)
class Case:
    """One output: its standardised points, its unseen steps with the factor of their targets, and what a fit takes."""

    x: Tensor  # (n, d)
    y: Tensor  # (n,)
    unseen: Tensor  # (m, d)
    truth: Tensor  # (m,) standardised as y
    factor: Tensor  # (m,) deviations of the output on unseen steps in one unit of y
    options: FitOptions
    mirror: Reflection | None
    action: Tensor  # (d,) bool, which inputs are features of the action
    may: Tensor  # (d,) bool, which inputs may be left out
    hyper: Hyperparameters

    def only(self, kept: Tensor) -> Case:
        """The case with some of the inputs, ``kept`` (d,) bool."""
        mirror = None if self.mirror is None else replace(self.mirror, signs=self.mirror.signs[kept])
        hyper = replace(self.hyper, lengthscale=self.hyper.lengthscale[kept], reflection=mirror)
        x, unseen, action = self.x[:, kept], self.unseen[:, kept], self.action[kept]
        return replace(self, x=x, unseen=unseen, action=action, may=self.may[kept], mirror=mirror, hyper=hyper)

    def further(self, more: Callable[[Tensor], Tensor]) -> Case:
        """The case with further inputs; those of mirror images have the signs of what they are made of."""
        mirror = self.mirror
        if mirror is not None:
            probe = torch.full_like(self.x[:1], 0.7)
            signs = (more(probe * mirror.signs) * more(probe)).sign()[0]
            mirror = replace(mirror, signs=torch.cat([mirror.signs, signs]))
        x, unseen = (torch.cat([z, more(z)], 1) for z in (self.x, self.unseen))
        action = torch.cat([self.action, torch.zeros(x.shape[1] - len(self.action), dtype=torch.bool)])
        return replace(self, x=x, unseen=unseen, action=action, mirror=mirror)

    def scores(self, mean: Tensor, variance: Tensor) -> dict[str, float]:
        """Scores of predictions (m,) of the unseen steps, noise included."""
        return scored((mean - self.truth) * self.factor, variance * self.factor**2)

    def judged(self, hyper: Hyperparameters) -> dict[str, float]:
        """Scores of the process with these hyperparameters."""
        mean, variance = condition(hyper, self.x, self.y).mean_and_variance(self.unseen)
        return self.scores(mean, variance + hyper.noise_variance)

    def fitted(self) -> Fitted:
        """Fit as products do."""
        return fit(self.x, self.y, self.options, reflection=self.mirror)


class Composite:
    """Negative log evidence of a process with another covariance, by automatic differentiation. It has the parameters
    of the process as it is, and then its own. Subclasses give the covariance.

    Args:
        case: the output.
        own: mean and deviation of the prior of each parameter of its own.
        lower, upper: their bounds.
    """

    def __init__(self, case: Case, own: Sequence[tuple[float, float]], lower: np.ndarray, upper: np.ndarray) -> None:
        self.case, self.options, self.d = case, case.options, case.x.shape[1]
        self.plain = Evidence(case.x, case.y, case.options, case.mirror)
        self.inner = len(self.plain.prior)
        self.prior = torch.tensor(np.concatenate([self.plain.prior, own]))
        self.lower = np.concatenate([self.plain.lower, lower])
        self.upper = np.concatenate([self.plain.upper, upper])

    def k(self, theta: Tensor, a: Tensor, b: Tensor) -> Tensor:
        """Latent covariance of a (m, d) and b (n, d)."""
        raise NotImplementedError

    def polynomial(self, theta: Tensor, a: Tensor, b: Tensor) -> Tensor | float:
        """The linear and the quadratic part of the process as it is."""
        mirror, made = self.case.mirror, 0.0
        kept = torch.ones(self.d, dtype=torch.float64) if mirror is None else mirror.kept
        even = 1.0 if mirror is None or mirror.parity > 0 else 0.0
        if self.options.linear:
            made = made + theta[self.d + 1].exp() * (even + (a * kept) @ b.T)
        if self.options.quadratic:
            made = made + theta[self.inner - 2].exp() * even * (a**2 @ (b**2).T)
        return made

    def start(self, *own: float) -> np.ndarray:
        """The process as it is, with the first parameters of its own; the others have the prior's means."""
        more = self.prior[self.inner :, 0].numpy().copy()
        more[: len(own)] = own
        return np.concatenate([self.plain.theta(self.case.hyper), more])

    def __call__(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        at = torch.tensor(theta, requires_grad=True)
        try:
            value = self._loss(at)
            value.backward()
        except torch.linalg.LinAlgError:
            return 1e10, np.zeros_like(theta)
        assert at.grad is not None
        return float(value.detach()), at.grad.numpy()

    def scores(self, theta: np.ndarray) -> dict[str, float]:
        """Scores on the unseen steps."""
        at, case = torch.from_numpy(theta), self.case
        factor = torch.linalg.cholesky(self._noisy(at))
        across = self.k(at, case.x, case.unseen)
        white = torch.linalg.solve_triangular(factor, torch.cat([case.y[:, None], across], 1), upper=False)
        prior = torch.cat([self.k(at, z[None], z[None])[0] for z in case.unseen])
        variance = (prior - white[:, 1:].square().sum(0)).clamp_min(0) + float(at[self.inner - 1].exp())
        return case.scores(white[:, 1:].T @ white[:, 0], variance)

    def _loss(self, theta: Tensor) -> Tensor:
        y = self.case.y
        factor = torch.linalg.cholesky(self._noisy(theta))
        white = torch.linalg.solve_triangular(factor, y[:, None], upper=False)
        z = (theta - self.prior[:, 0]) / self.prior[:, 1]
        fixed = 0.5 * len(y) * math.log(2 * math.pi) + self.prior[:, 1].log().sum()
        return 0.5 * white.square().sum() + factor.diagonal().log().sum() + 0.5 * z @ z + fixed

    def _noisy(self, theta: Tensor) -> Tensor:
        x = self.case.x
        return self.k(theta, x, x) + theta[self.inner - 1].exp() * torch.eye(len(x), dtype=x.dtype)


def real_steps(original: Any, q: Tensor, u: Tensor) -> Samples:
    """One real step from each of q (n, C) under u (n, F)."""
    steps = [original.step_from(*point) for point in zip(q.numpy(), u.numpy(), strict=True)]
    arrays = [
        np.array([np.asarray(getattr(s, name), dtype=np.float64) for s in steps])
        for name in ("coordinates", "action", "next_coordinates", "reward")
    ]
    return Samples(*map(torch.from_numpy, arrays), torch.tensor([bool(s.terminated) for s in steps]))


def case_of(
    definition: EnvironmentDefinition, output: OutputModel, column: int, samples: Samples
) -> tuple[Case, float] | None:
    """The case of an output of a model, and the log evidence of its process; None if nothing is to be learned."""
    if output.posterior is None:
        return None
    chosen, posterior, lead = output.feature_map, output.posterior, leading(definition)
    if output.name == REWARD:
        used, target = ~samples.terminated, samples.reward
        q = samples.q_next if chosen.after else samples.q
    else:
        q, target = samples.q, increments(definition, samples)[:, column]
        used = usable(definition, column, samples.q_next, chosen, past_limits=output.past_limits)
    x = encode(definition, chosen, q, samples.u, samples.q_next[:, lead])[used]
    target, std = target[used], float(target[used].std(correction=0))
    if len(target) < UNSEEN // 10 or std < 1e-9:
        return None
    mirror = reflection(definition, chosen)
    options = FitOptions(quadratic=output.name == REWARD)
    objective = Evidence(posterior.x, posterior.y, options, mirror)
    value, theta = minimum(objective, objective.theta(posterior.hyper))
    entries = torch.tensor([f.entry for f in features(definition, chosen)])
    given = torch.tensor([f.function in ("affine", "equal", "grown") for f in features(definition, chosen)])
    made = Case(
        posterior.x,
        posterior.y,
        x,
        output.standardised(target, x),
        output.scale * output.amplitude(x) / std,
        options,
        mirror,
        given & (entries >= len(definition.coordinates)),
        torch.tensor([f.function not in ("lead", "grown") for f in features(definition, chosen)]),
        objective.hyper(theta),
    )
    return made, -value


def definition_of(original: Any, settings: Mapping[str, Any], **design: Any) -> EnvironmentDefinition:
    """The definition of an environment whose reward is learned, with settings of the processes and of the design."""
    chosen = Design.model_validate({**design, "model": {"name": "gaussian_process", "settings": dict(settings)}})
    return definition_from_spec(original.spec().model_copy(update={"design": chosen, "reward": Reward()}))


def unseen_steps(original: Any, definition: EnvironmentDefinition) -> Samples:
    rng = np.random.default_rng(UNSEEN_SEED)
    return real_steps(original, *going_on(definition, *random_points(definition, UNSEEN, rng), rng))


def hypercube(original: Any, definition: EnvironmentDefinition, size: int, seed: int) -> Samples:
    """Real steps of a Latin hypercube."""
    rng = np.random.default_rng(seed)
    return real_steps(original, *going_on(definition, *latin_hypercube(definition, size, rng), rng))


def designed(original: Any, seed: int, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Real steps of an adaptive design without a policy, its error on unseen steps, and its processor time."""
    definition = definition_of(original, settings, seed=seed)
    unseen = real_steps(original, *random_points(definition, UNSEEN, np.random.default_rng(UNSEEN_SEED)))
    samples, state = real_steps(original, *arrays(initial_queries(definition, BUDGET))), DesignState()
    begun = time.process_time()
    while len((made := advance(definition, samples, state, Request(BUDGET, 0.999))).queries):
        samples, state = join(samples, real_steps(original, *arrays(made.queries))), made.state
    seconds = time.process_time() - begun
    off = made.model.transition(unseen.q, unseen.u).q_next - unseen.q_next
    off[:, definition.angles] = wrap(off[:, definition.angles])
    error = float((off[:, definition.moving] / increments(definition, unseen).std(0)).square().mean().sqrt())
    return {"real steps": len(samples), "error": error, "seconds": seconds}


def table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line for each structure and number of samples."""
    lines = []
    where = ("task", "n", "seed", "output")
    before = {tuple(r[k] for k in where): r for r in rows if r["structure"] == AS_IT_IS}
    for structure in dict.fromkeys(r["structure"] for r in rows if r["structure"] != AS_IT_IS):
        for n in sorted({r["n"] for r in rows}):
            every = [r for r in rows if (r["structure"], r["n"]) == (structure, n)]
            pairs = [(r, before[tuple(r[k] for k in where)]) for r in every if r["chosen"]]
            line = f"| {structure} | {n} | {len(pairs)} of {len(every)} |"
            if pairs:
                ratio = math.exp(np.mean([math.log((r["error"] + 1e-3) / (b["error"] + 1e-3)) for r, b in pairs]))
                grown = np.array([r["density"] - b["density"] for r, b in pairs])
                old, new = (np.mean([pair[i]["coverage"] for pair in pairs]) for i in (1, 0))
                line += f" {ratio:.2f} | {grown.mean():+.2f} | {(grown > 0.1).sum()}, {(grown < -0.1).sum()} |"
                line += f" {100 * old:.0f} %, {100 * new:.0f} % |"
            lines.append(line)
    return lines
