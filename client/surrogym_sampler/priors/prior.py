"""A simulator as a prior: its parameters are calibrated on real steps, and its model is learned from simulated steps.

Shapes: n steps, C coordinates, F action entries.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np

from surrogym_sampler.original.actions import middle_action
from surrogym_sampler.original.adapters import adapter_of
from surrogym_sampler.original.episodes import draw
from surrogym_sampler.original.errors import StepRefused, UnknownEnvironment
from surrogym_sampler.original.loading import Respecified, is_own, make, with_choices
from surrogym_sampler.original.periods import require_period
from surrogym_sampler.original.protocol import Array, OriginalEnvironment, RealStep, is_number
from surrogym_sampler.priors.calibration import (
    Calibration,
    RealTransitions,
    Step,
    Steps,
    adjustable,
    calibrate,
    layers,
    own_name,
    read_parameters,
)
from surrogym_shared.spec import DeclaredReward, EnvironmentSpec, RewardTerm
from surrogym_shared.surrogate_file import SurrogateFile
from surrogym_shared.wire.priors import CalibratedParameter, PriorAbout

BY_INPUT = 50  # default number of simulated steps to learn from, for each coordinate and action entry
FEWEST, MOST = 100, 400  # smallest and largest default number of simulated steps
FURTHER = 1_000  # default number, if the model of so many is not certain
WORSE = 1.5  # if the error on the real steps so far exceeds this multiple of the calibration's error, calibrate again
AGAIN = 2  # the parameters are calibrated again when there are this many times the steps of the last calibration
TRIALS = 5  # number of steps that test whether a simulator works
REPORT_SECONDS = 1.0  # time between two reports of a calibration's progress
SLOW = 0.1  # seconds of a simulated step that counts as slow, if the seconds of a real step are not known
LONGEST_SOURCE = 200  # largest number of characters in the description of a prior's source
NOTHING = DeclaredReward(kind="declared", terms=(RewardTerm(weight=0.0, shape="one"),))
SAME = 1e-6  # results of the same step that differ by less, in parts or absolutely, count as equal
RIGHT = 1e-3  # if the simulator's error is below this share of the coordinates' changes, its parameters are kept

StepsFrom = Callable[[Array, Array], Array]  # from coordinates (n, C) with actions (n, F) to next coordinates (n, C)
Progress = Callable[[float | None, str], None]


def silent(share: float | None, words: str) -> None:
    """Do nothing: the default callback for progress."""
    del share, words


class Careful:
    """A simulator that refuses each step that it can't take, so that the design chooses another one."""

    parallel = True

    def __init__(self, simulator: OriginalEnvironment) -> None:
        self._simulator = simulator

    def spec(self) -> EnvironmentSpec:
        return self._simulator.spec()

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        """Take a step from coordinates (C,) with an action (F,). Raises ``StepRefused`` if the simulator raises any
        error or returns numbers that are not finite."""
        try:
            step = self._simulator.step_from(coordinates, action)
            numbers = [*np.ravel(step.coordinates), *np.ravel(step.next_coordinates), step.reward]
        except Exception as error:  # a user's code may raise anything
            raise StepRefused(
                f"the simulator failed: {type(error).__name__}: {error}; correct the simulator"
            ) from error
        if not np.isfinite(numbers).all():
            raise StepRefused(
                "expected finite numbers from the simulator, got infinite numbers or NaN: correct the simulator, or "
                "narrow the sampling ranges"
            )
        return step

    def close(self) -> None:
        self._simulator.close()


class SimulatorPrior(ABC):
    """Prior knowledge about a plant: a simulator that can be set to any state, and ranges of its parameters.

    A subclass decides where the simulator's model is learned.

    Args:
        simulator: an environment with ``step_from``, or its name as for ``original.make``. ``close`` closes it.
        spec: specification of the plant. The simulator has the same coordinates and actions.
        parameters: parameters to be calibrated, each as ``NAME`` or ``NAME=LOW..HIGH``.
        steps: number of simulated steps from which the model is learned. None chooses 100 to 400 by the number of
            inputs, and 1,000 if the model is then not certain within its tolerances and the simulator is fast.

    Raises:
        UnknownEnvironment: the simulator can't be opened, or can't be set to a state; or some coordinates of the plant
            repeat earlier values (lags).
        ValueError: the simulator has no such parameter, or a range is invalid.
    """

    def __init__(
        self,
        simulator: str | OriginalEnvironment,
        spec: EnvironmentSpec,
        parameters: Sequence[str] = (),
        *,
        steps: int | None = None,
    ) -> None:
        if any(coordinate.lag is not None for coordinate in spec.coordinates):
            raise UnknownEnvironment(
                "expected a plant without lags (coordinates that repeat earlier values), because a simulator can't be "
                "set to earlier values, got a plant with lags: learn it without a prior"
            )
        size = len(spec.coordinates) + spec.action.size
        self.steps = min(MOST, max(FEWEST, BY_INPUT * size)) if steps is None else steps
        self.spec = _of_steps(spec, self.steps)
        self._may_extend, self._seconds = steps is None, 0.0  # the mean seconds of a simulated step, once measured
        self.simulator = _opened(simulator, self.spec)
        self.source = self._words(simulator)
        adapter = adapter_of(simulator) if isinstance(simulator, str) else None
        # whether the simulator has a reward
        self.pays = (adapter is None or adapter.pays) and getattr(layers(self.simulator)[-1], "pays", True)
        plant = adjustable(self.simulator)
        self.parameters = read_parameters(parameters, plant)
        self._set, present = plant.set_parameters, plant.parameters()
        # Takes many steps at once; None if the simulator can't.
        self._steps_from: StepsFrom | None = getattr(self.simulator, "steps_from", None)
        self._own = np.array([present[parameter.name] for parameter in self.parameters])
        if self.parameters:
            _require_repeatable(self.simulator, self.spec)
        self.calibration: Calibration | None = None
        self._calibrated_on = 0  # number of real steps in the last calibration
        self.file: SurrogateFile | None = None

    @abstractmethod
    def learn(self, say: Progress) -> tuple[SurrogateFile, float]:
        """Learn a model of the simulator with its current parameters from simulated steps, and return the model and its
        confidence index. The attribute ``steps`` is their number.

        ``say`` is called with the share of the work that is done, and a few words.
        """

    def update(self, real: Sequence[RealStep], progress: Progress = silent) -> bool:
        """Calibrate the parameters as ``calibrate`` does, and learn the simulator's model again if their values
        changed. Returns whether there is a new model in ``file``.

        Raises:
            NotCalibrated: there are too few real steps for the parameters, or the simulator can't take most of them.
            InvalidInput, NumericalFailure: the simulator's model can't be learned.
        """
        if not self.calibrate(real, progress):
            return False
        assert self.calibration is not None
        file, confidence = self.learned(progress)
        self.file = replace(file, about=self._about(self.calibration, confidence))
        return True

    def calibrate(self, real: Sequence[RealStep], progress: Progress = silent) -> bool:
        """Calibrate the parameters on all real steps so far, unless the present values are right for them.

        Args:
            real: the real steps, at least two.
            progress: called with the share of the work that is done, and a few words.

        Returns:
            Whether the values changed.

        Raises:
            NotCalibrated: there are too few real steps for the parameters, or the simulator can't take most of them.
        """
        steps = _transitions(real)
        present = None if self.calibration is None else self._error(steps, self.calibration)
        if self.calibration is not None and present is not None:
            is_right = present <= max(RIGHT, WORSE * self.calibration.error)
            if is_right and len(real) < AGAIN * self._calibrated_on:
                return False
        names = ", ".join(parameter.name for parameter in self.parameters)
        words = f"{'calibrating ' + names if names else 'comparing'} on {len(real)} real steps"
        progress(0.0, words)
        step = _Reported(
            self._step, self._steps, self.spec.sampling_period or SLOW, lambda more: progress(0.0, f"{words}: {more}")
        )
        many = None if self._steps_from is None else step.many
        found = calibrate(self.spec, steps, self.parameters, self._own, step, many)
        self._calibrated_on = len(real)
        if present is not None and present <= max(RIGHT, WORSE * found.error):
            return False
        self.calibration = found
        self._set(found.values)
        self._seconds = step.seconds
        return True

    def set_parameters(self, values: Mapping[str, float]) -> None:
        """Give some of the named parameters these values, for example those of a calibration of another simulator of
        the same plant. Raises ``ValueError``, and changes nothing, if one was not named when the prior was made, is
        not a finite number, or is refused by the simulator."""
        names = [parameter.name for parameter in self.parameters]
        if unknown := [name for name in values if name not in names]:
            raise ValueError(
                f"expected values of {', '.join(names) or 'no parameter'}, got one of {unknown[0]}: name it when the "
                "prior is made"
            )
        for name, value in values.items():
            if not is_number(value):
                raise ValueError(f"expected a finite number for {name}, got {value!r}")
        self._set(values)

    def learned(self, progress: Progress = silent) -> tuple[SurrogateFile, float]:
        """Learn a model of the simulator with its current parameters, and return it and its confidence index. If no
        number of simulated steps was given, the simulator is not slow, and the model is not certain, learn it from more
        steps."""
        file, confidence = self.learn(progress)
        if self._may_extend and confidence < self.spec.design.target and self._seconds < SLOW:
            self._may_extend, self.steps = False, FURTHER
            self.spec = _of_steps(self.spec, self.steps)
            file, confidence = self.learn(progress)
        return file, confidence

    def close(self) -> None:
        """Close the simulator."""
        self.simulator.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _words(self, simulator: str | OriginalEnvironment) -> str:
        """Return the name of the simulator, and which coordinates it matched to variables by their places."""
        name = simulator if isinstance(simulator, str) else own_name(simulator)
        matched = ", ".join(getattr(layers(self.simulator)[-1], "matched", ()))
        return (name + (f" ({matched})" if matched else ""))[:LONGEST_SOURCE]

    def _set_all(self, values: Array) -> None:
        self._set({parameter.name: float(value) for parameter, value in zip(self.parameters, values, strict=True)})

    def _steps(self, values: Array, coordinates: Array, actions: Array) -> Array:
        assert self._steps_from is not None
        self._set_all(values)
        return self._steps_from(coordinates, actions)

    def _step(self, values: Array, coordinates: Array, action: Array) -> Array:
        self._set_all(values)
        return np.asarray(self.simulator.step_from(coordinates, action).next_coordinates, dtype=np.float64)

    def _error(self, steps: RealTransitions, by: Calibration) -> float:
        """Return the simulator's error on real steps, with the parameter values of the calibration ``by``."""
        values = np.array([by.values[parameter.name] for parameter in self.parameters])
        many = None if self._steps_from is None else self._steps
        return calibrate(self.spec, steps, (), values, self._step, many).error

    def _about(self, found: Calibration, confidence: float) -> dict[str, Any]:
        return PriorAbout(
            source=self.source,
            parameters=[CalibratedParameter(**vars(parameter)) for parameter in found.parameters],
            real_steps=found.steps,
            failed_steps=found.failed,
            error_before=found.error_before,
            error=found.error,
            simulated_steps=self.steps,
            confidence_index=confidence,
        ).model_dump(mode="json")


def _of_steps(spec: EnvironmentSpec, steps: int) -> EnvironmentSpec:
    """Return the specification for a design of so many simulated steps anywhere in the sampling ranges."""
    return with_choices(spec, {"initial": steps, "budget": steps}, access="any")


class _Reported:
    """A function that takes a step of a simulator, and that reports how many steps it took and what each costs.

    Args:
        step: the function, as for ``calibrate``.
        many: the function that takes many steps, as for ``calibrate``.
        most: seconds of a step beyond which the report says how fewer steps are needed.
        report: called about once in a second, with a few words.
    """

    def __init__(self, step: Step, many: Steps, most: float, report: Callable[[str], None]) -> None:
        self._step, self._many, self._most, self._report = step, many, most, report
        self._taken, self._busy, self._due = 0, 0.0, time.monotonic() + REPORT_SECONDS

    @property
    def seconds(self) -> float:
        """Mean seconds of a step so far."""
        return self._busy / max(1, self._taken)

    def __call__(self, values: Array, coordinates: Array, action: Array) -> Array:
        return self._timed(1, lambda: self._step(values, coordinates, action))

    def many(self, values: Array, coordinates: Array, actions: Array) -> Array:
        """Take n steps at once."""
        return self._timed(len(coordinates), lambda: self._many(values, coordinates, actions))

    def _timed(self, count: int, take: Callable[[], Array]) -> Array:
        began = time.monotonic()
        reached = take()
        self._taken += count
        self._busy += (now := time.monotonic()) - began
        if now > self._due:
            self._due = now + REPORT_SECONDS
            each = self.seconds
            slow = (
                ", and a calibration takes hundreds of them: name fewer parameters, or learn a surrogate of the "
                "simulator beforehand, and use surrogate:NAME"
            )
            self._report(f"{self._taken} steps of the simulator, {each:.2g} s each{slow if each > self._most else ''}")
        return reached


def _opened(simulator: str | OriginalEnvironment, spec: EnvironmentSpec) -> OriginalEnvironment:
    """Open a simulator, and test it with a few steps.

    Raises:
        UnknownEnvironment: the simulator has other coordinates, units or actions than the plant, or can't take any of
            these steps.
    """
    opened: Any = make(simulator) if isinstance(simulator, str) and is_own(simulator) else simulator
    try:
        if not isinstance(opened, str):
            _require_alike(spec, opened.spec())
            require_period("the simulator", spec, opened.spec().sampling_period)
            if not callable(getattr(opened, "step_from", None)):
                raise UnknownEnvironment(
                    "expected a simulator with a method step_from, which sets it to a state, got none: add the method"
                )
        environment: OriginalEnvironment = _respecified(simulator, opened, spec)
        _require_steps(environment, spec)
    except BaseException:
        if isinstance(simulator, str) and not isinstance(opened, str):
            opened.close()
        raise
    return environment


def _respecified(simulator: str | OriginalEnvironment, opened: Any, spec: EnvironmentSpec) -> Any:
    """Return the simulator with the plant's specification. A simulator that is given by an adapter's name is opened
    here, because such a name comes without a specification. If it has no reward and the plant's is learned, its reward
    is 0."""
    if not isinstance(simulator, str) or (adapter := adapter_of(simulator)) is None:
        return Respecified(opened, spec)
    named = spec.model_copy(update={"environment": simulator})
    if adapter.pays or spec.reward.kind == "declared":
        return make(simulator, spec=named)
    return Respecified(make(simulator, spec=named.model_copy(update={"reward": NOTHING})), spec)


def _require_alike(spec: EnvironmentSpec, own: EnvironmentSpec) -> None:
    for what, expected, got in (
        ("coordinates", _coordinates(spec), _coordinates(own)),
        ("action", *(one.action.model_dump(exclude={"bins"}) for one in (spec, own))),
    ):
        if expected != got:
            raise UnknownEnvironment(
                f"expected a simulator with the plant's {what}, {expected}, got {got}: give the simulator the same "
                f"{what}"
            )


def _coordinates(spec: EnvironmentSpec) -> list[str]:
    """Return name, kind and unit of each coordinate, in words."""
    return [" ".join([one.name, f"({one.kind})", one.unit or ""]).strip() for one in spec.coordinates]


def _require_steps(environment: OriginalEnvironment, spec: EnvironmentSpec) -> None:
    """Check that the simulator can take at least one of a few steps from random states of the sampling ranges."""
    reached, why = _tried(environment, spec)
    if reached is None:
        raise UnknownEnvironment(
            f"expected a simulator that steps from states in its sampling ranges to {len(spec.coordinates)} finite "
            f"coordinates, got a simulator that failed in all {TRIALS} trials: {why}; "
            "correct the simulator, or narrow the sampling ranges"
        )


def _require_repeatable(environment: OriginalEnvironment, spec: EnvironmentSpec) -> None:
    """Check that the same step has the same result twice, without which no effect of a parameter can be measured."""
    (one, _), (other, _) = (_tried(environment, spec) for _ in range(2))
    if one is None or other is None or not np.allclose(one, other, rtol=SAME, atol=SAME):
        raise UnknownEnvironment(
            "expected a simulator whose step from the same state with the same action has the same result twice, got "
            f"{_listed(one)} and {_listed(other)}: switch its noise off, or leave out the parameters"
        )


def _tried(environment: OriginalEnvironment, spec: EnvironmentSpec) -> tuple[Array | None, str]:
    """Return the coordinates (C,) after the first of a few steps from random states that the simulator can take, or
    None, and why the last of the others failed."""
    rng, why = np.random.default_rng(0), ""
    for _ in range(TRIALS):
        start = draw(spec, rng, wide=True)
        try:
            reached = np.asarray(environment.step_from(start, middle_action(spec)).next_coordinates)
            if reached.shape == start.shape and np.isfinite(reached).all():
                return reached, why
            why = f"it gave {reached.tolist()}"
        except Exception as error:  # a user's code may raise anything
            why = f"{type(error).__name__}: {str(error)[:200]}"
    return None, why


def _listed(reached: Array | None) -> str:
    return "a failure" if reached is None else str(reached.tolist())


def _transitions(real: Sequence[RealStep]) -> RealTransitions:
    columns = (
        np.array([getattr(step, name) for step in real], dtype=np.float64).reshape(len(real), -1)
        for name in ("coordinates", "action", "next_coordinates")
    )
    return RealTransitions(*columns)
