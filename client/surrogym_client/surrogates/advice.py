"""Describe how certain a surrogate's model is, and advise on the most useful next step."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from math import ceil, hypot, log, sqrt
from statistics import NormalDist

from surrogym_client.surrogates.waiting import COMPLETED
from surrogym_shared.environments import is_name
from surrogym_shared.wire import DoubtfulRegion, ModelView, OutputFidelity, ReachedLimit, SurrogateView

NEARLY = 0.9  # the target counts as nearly reached if the confidence index has reached this share of it
# No number of further real steps is forecast if it exceeds this multiple of the present number of samples.
MOST_STEPS = 10.0
# Further real steps help if they lower the leave-one-out error to less than this share of its earlier value.
NOTICEABLE = 0.9
FEWEST_MODELS = 4  # the speed of learning is estimated from at least this number of successive models
NOISY_SLACK = 1.25  # if an output has confirmed noise, its leave-one-out error may be this multiple of its tolerance
MOSTLY_NOISE = 0.8  # if noise has this share of the squared leave-one-out error, more real steps hardly help
# An output's tolerance is a share of the spread of its initial samples. If it is below this share of the leave-one-out
# error, all initial samples had the same value.
TOLERABLE = 1e-6


def verdict(view: SurrogateView) -> str:
    """Describe how certain the model is: ready, ready but for one output, nearly ready, or not. Empty without a
    model."""
    if view.fidelity is None:
        return ""
    outputs = view.fidelity.outputs
    doubtful = _doubtful(view)
    if view.phase == "ready":
        return "ready"
    if not doubtful:
        return "certain of its model, which adaptive queries have not tested yet"
    named = ", ".join(_named(output, view.target) for output in doubtful)
    if len(doubtful) == 1 and len(outputs) > 1:
        return f"ready but for {named}"
    nearly = all(output.confidence_index >= NEARLY * view.target for output in doubtful)
    return f"{'nearly ready' if nearly else 'not ready'}: {named}"


def advice(view: SurrogateView, models: Sequence[ModelView]) -> str:
    """Describe the next step for a design that has ended without being ready, with its cost in real steps. Empty if
    there is no advice.

    Args:
        view: the surrogate.
        models: all versions of its model, oldest first, which show how fast it learns.
    """
    doubtful = _doubtful(view)
    if view.phase not in COMPLETED or view.phase in ("ready", "from_log") or not doubtful:
        return ""
    worst = doubtful[0]
    error = worst.leave_one_out_error
    if error is None:
        return ""
    if past := [output for output in view.fidelity.outputs if output.past] if view.fidelity else []:
        return _of_past(view, past)
    if view.spec.needs_trials and view.phase == "unsure" and view.budget_left:
        return (
            f"trials of policies take the other {view.budget_left} real steps of the budget, while a sampler runs: "
            f"surrogym train {view.name}"
        )
    if worst.tolerance < TOLERABLE * error:
        return (
            f"all initial samples had the same {worst.name}, so its tolerance is {worst.tolerance:.2g}; declare it in "
            "the specification, or set a tolerance that matters: "
            f"surrogym change {view.name} --tolerance {worst.name}=VALUE"
        )
    if _share_of_noise(worst) >= MOSTLY_NOISE and worst.confidence_index >= NEARLY * view.target:
        return _of_noise(view, worst)
    steps = _steps_to_go(view, worst, models) if len(models) >= 2 * FEWEST_MODELS else None
    if steps is not None:
        return f"about {steps} more real steps at the present rate: surrogym improve {view.name} --queries {steps}"
    if limits := view.fidelity.limits if view.fidelity else []:
        return _of_limit(limits[0])
    if len(models) < 2 * FEWEST_MODELS:
        return (
            "too few rounds to estimate the progress; to take as many real steps again: "
            f"surrogym improve {view.name} --queries {max(view.samples, 1)}"
        )
    return (
        f"{_too_slow(worst, models)}; it would be ready with a tolerance of {_within_reach(view, worst):.2g} (now "
        f"{_declarable(worst):.2g}): {_widen(view, worst)}"
    )


def noise_in_words(view: SurrogateView) -> str:
    """Describe how much of each output's squared leave-one-out error is confirmed noise. Empty without noise."""
    outputs = [] if view.fidelity is None else view.fidelity.outputs
    return ", ".join(_noise_of(output) for output in outputs if output.noise)


def _noise_of(output: OutputFidelity) -> str:
    if not output.leave_one_out_error:
        return f"{output.name} {output.noise:.2g}"
    sensor = f", mainly the sensor's: {output.sensor_noise:.2g} a measurement" if output.sensor_noise else ""
    return f"{output.name} {output.noise:.2g} ({100 * _share_of_noise(output):.0f} % of its squared error{sensor})"


def _share_of_noise(output: OutputFidelity) -> float:
    """Return the share of the squared leave-one-out error that is confirmed noise; 0 without an error."""
    error = output.leave_one_out_error
    return min(1.0, (output.noise / error) ** 2) if error else 0.0


def _of_past(view: SurrogateView, outputs: Sequence[OutputFidelity]) -> str:
    """Advise on outputs whose errors depend on the step before: a dead time or a state is missing in the
    specification."""
    shares = ", ".join(f"{100 * output.past:.0f} % of the squared error of {output.name}" for output in outputs)
    name = view.environment
    env = shlex.quote(name) if is_name(name) and not name.startswith("exec:") else "ENVIRONMENT"
    return (
        f"the step before explains {shares}: that is no noise, but a dead time or a state that is not measured. To see "
        f"which earlier actions and changes the specification lacks: surrogym doctor --env {env} --history 60"
    )


def _of_noise(view: SurrogateView, output: OutputFidelity) -> str:
    """Advise on an output whose error is nearly all noise."""
    remedy = "average several readings of its sensor" if output.sensor_noise else "reduce the noise itself"
    return (
        f"the error of {output.name} is nearly all noise ({100 * _share_of_noise(output):.0f} % of its square), which "
        f"more real steps don't lower; {remedy}, or accept a tolerance of "
        f"{_within_reach(view, output):.2g} (now {_declarable(output):.2g}): {_widen(view, output)}"
    )


def _of_limit(limit: ReachedLimit) -> str:
    """Advise on a design whose samples often end at a limit of a coordinate."""
    return (
        f"{100 * limit.share:.0f} % of the samples end at the {limit.side} limit of {limit.coordinate}, "
        f"{limit.value:.4g}, and say little about the dynamics; register under a new name with sampling ranges from "
        "which fewer steps end there"
    )


def _widen(view: SurrogateView, output: OutputFidelity) -> str:
    """Return the command that declares a tolerance so large that the output would no longer keep the design from being
    ready."""
    return f"surrogym change {view.name} --tolerance {output.name}={_within_reach(view, output):.2g}"


def _declarable(output: OutputFidelity) -> float:
    """Return an output's tolerance without the noise that the server adds to it."""
    return _beyond(output.tolerance, output.noise) if output.noise else output.tolerance


def _doubtful(view: SurrogateView) -> list[OutputFidelity]:
    """Return the outputs that keep the design from being ready, the least certain first."""
    outputs = [] if view.fidelity is None else view.fidelity.outputs
    unsure = [output for output in outputs if output.confidence_index < view.target or not _agrees(output)]
    return sorted(unsure, key=lambda output: output.confidence_index)


def _agrees(output: OutputFidelity) -> bool:
    return output.leave_one_out_error is not None and output.leave_one_out_error <= _largest_error(output)


def _largest_error(output: OutputFidelity) -> float:
    """Return the largest leave-one-out error with which the server counts an output as known."""
    return output.tolerance * _slack(output)


def _slack(output: OutputFidelity) -> float:
    """Return the largest leave-one-out error that the server allows, as a multiple of the tolerance."""
    return NOISY_SLACK if output.noise else 1.0


def _named(output: OutputFidelity, target: float) -> str:
    if output.confidence_index < target:
        return f"{output.name}{_where(output.region)} (confidence {output.confidence_index:.4g} of {target:g})"
    error = output.leave_one_out_error
    beyond = "unknown" if error is None else f"{error:.2g}"
    return f"{output.name} (leave-one-out error {beyond}, tolerance {output.tolerance:.2g})"


def _where(region: DoubtfulRegion | None) -> str:
    """Describe the region where a model is uncertain as the end of a sentence, such as " where x is above 2"; empty for
    None."""
    if region is None:
        return ""
    name, low, high = region.input, _end(region.low), _end(region.high)
    if low is None or high is None:
        return f" where {name} is {f'above {low}' if high is None else f'below {high}'}"
    return f" where {name} is {f'below {low} or above {high}' if region.outside else f'between {low} and {high}'}"


def _end(value: float | None) -> str | None:
    return None if value is None else f"{value:.3g}"


def _steps_to_go(view: SurrogateView, worst: OutputFidelity, models: Sequence[ModelView]) -> int | None:
    """Forecast the real steps until the output no longer keeps the design from being ready: its confidence index
    reaches the design's target, and its leave-one-out error the largest that is allowed. None if it does not improve,
    or far too slowly.

    The error, and the distance of the index from 1, are assumed to shrink exponentially, as over the last half of the
    fits.
    """
    late = models[len(models) // 2 :]
    seen = [(model.samples, output) for model in late for output in model.fidelity.outputs if output.name == worst.name]
    samples = [float(count) for count, _ in seen]
    lacks = [1 - output.confidence_index for _, output in seen]
    errors = [output.leave_one_out_error or 0.0 for _, output in seen]
    needed = [
        _forecast(samples, lacks, 1 - view.target),
        _forecast(samples, errors, _largest_error(worst)),
    ]
    if any(one is None for one in needed):
        return None
    steps = ceil(max(one for one in needed if one is not None))
    return max(steps, 1) if steps <= MOST_STEPS * view.samples else None


def _too_slow(worst: OutputFidelity, models: Sequence[ModelView]) -> str:
    """Return a sentence that more real steps hardly help an output, with its errors at the last half of the fits."""
    seen = [
        (model.samples, output.leave_one_out_error)
        for model in models[len(models) // 2 :]
        for output in model.fidelity.outputs
        if output.name == worst.name and output.leave_one_out_error is not None
    ]
    if not seen or seen[-1][1] > NOTICEABLE * seen[0][1]:
        return f"more real steps hardly help {worst.name}"
    (first, before), (last, after) = seen[0], seen[-1]
    return (
        f"the last {last - first} real steps lowered the leave-one-out error of {worst.name} from {before:.3g} to "
        f"{after:.3g}, but its target is out of reach at the present rate"
    )


def _forecast(samples: Sequence[float], values: Sequence[float], limit: float) -> float | None:
    """Forecast the number of further samples until values that decrease exponentially reach the limit; None if the
    values don't decrease."""
    if values[-1] <= limit:
        return 0.0
    logs = [log(max(value, 1e-300)) for value in values]
    middle, level = sum(samples) / len(samples), sum(logs) / len(logs)
    spread = sum((x - middle) ** 2 for x in samples)
    if not spread or limit <= 0:
        return None
    slope = sum((x - middle) * (y - level) for x, y in zip(samples, logs, strict=True)) / spread
    return (log(limit) - log(values[-1])) / slope if slope < 0 else None


def _within_reach(view: SurrogateView, output: OutputFidelity) -> float:
    """Return the tolerance with which the output would no longer keep the design from being ready, if its standard
    deviation is the same everywhere.

    The server adds the noise to a tolerance, but does not count noise that is much smaller than the tolerance.
    """
    z = NormalDist().inv_cdf
    index = min(max(output.confidence_index, 0.5 + 1e-9), 1 - 1e-12)
    allowed = _declarable(output)
    by_deviation = (
        hypot(allowed, output.noise) * z(view.target) / z(index) if output.confidence_index < view.target else 0.0
    )
    if index <= 0.51:
        by_deviation = allowed
    error = output.leave_one_out_error or 0.0
    beside = max(_beyond(by_deviation, output.noise), _beyond(error / _slack(output), output.noise), allowed)
    return beside if beside <= output.noise else max(error, by_deviation)


def _beyond(value: float, part: float) -> float:
    """Return the standard deviation ``value`` less an independent ``part``: sqrt(value^2 - part^2), at least 0."""
    return sqrt(max(value**2 - part**2, 0.0))
