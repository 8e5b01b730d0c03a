"""A simulator as a prior: its parameters are calibrated on real steps, and its model is learned without real steps.

Shapes: n steps, C coordinates, F action entries.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np

from surrogym_sampler.original.errors import UnknownEnvironment
from surrogym_sampler.original.loading import make, with_choices
from surrogym_sampler.original.protocol import Array, OriginalEnvironment, RealStep
from surrogym_sampler.priors.calibration import Calibration, RealTransitions, calibrate
from surrogym_sampler.priors.parameters import adjustable, read_parameters
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.surrogate_file import SurrogateFile
from surrogym_shared.wire.priors import CalibratedParameter, PriorAbout

BY_INPUT = 50  # steps of the simulator for each coordinate and action entry
FEWEST, MOST = 100, 400  # of these steps
WORSE = 1.5  # ratio of errors on real steps from which values are taken for outdated
AGAIN = 2  # growth of the number of real steps after which the parameters are calibrated again
RIGHT = 1e-3  # of the changes: an error that is small enough

Progress = Callable[[float | None, str], None]


def silent(share: float | None, words: str) -> None:
    """Show no progress."""
    del share, words


class SimulatorPrior(ABC):
    """What is known of a plant beforehand: a simulator that can be set to any state, and ranges of its parameters.

    Where its model is learned is up to the subclass.

    Args:
        simulator: an environment with ``step_from``, or its name as for ``original.make``. ``close`` closes it.
        spec: specification of the plant. The simulator has the same coordinates and actions.
        parameters: parameters to be calibrated, each as ``NAME`` or ``NAME=LOW..HIGH``.
        steps: steps of the simulator that its model is learned from. None chooses 100 to 400 by the number of inputs.

    Raises:
        UnknownEnvironment: the simulator can't be opened, or can't be set to a state; or the plant's coordinates have
            lags.
        ValueError: the simulator has no such parameter, or a range is none.
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
            raise UnknownEnvironment("expected a plant without lags, because a simulator can't be set to a past")
        size = len(spec.coordinates) + spec.action.size
        self.steps = min(MOST, max(FEWEST, BY_INPUT * size)) if steps is None else steps
        self.source = simulator if isinstance(simulator, str) else type(simulator).__name__
        self.spec = with_choices(spec, {"initial": self.steps, "budget": self.steps}, access="any")
        self.simulator = _opened(simulator, self.spec)
        plant = adjustable(self.simulator)
        self.parameters = read_parameters(parameters, plant)
        self._set, present = plant.set_parameters, plant.parameters()
        self._own = np.array([present[parameter.name] for parameter in self.parameters])
        self.calibration: Calibration | None = None
        self._calibrated_on = 0  # real steps
        self.file: SurrogateFile | None = None

    @abstractmethod
    def learn(self, say: Progress) -> SurrogateFile:
        """Learn a model of the simulator, with its parameters as they are, from ``steps`` of its steps.

        ``say`` is called with the share that is done, and a few words.
        """

    def update(self, real: Sequence[RealStep], progress: Progress = silent) -> bool:
        """Calibrate the parameters on all real steps so far, and learn the simulator's model again if they moved it.

        Args:
            real: the real steps, at least two.
            progress: called with the share that is done, and a few words.

        Returns:
            Whether ``file`` is new.

        Raises:
            NotCalibrated: too few real steps for the parameters, or the simulator can't take most of them.
            InvalidInput, NumericalFailure: the simulator's model can't be learned.
        """
        steps = _transitions(real)
        present = None if self.calibration is None else self._error(steps, self.calibration)
        if self.calibration is not None and present is not None:
            is_right = present <= max(RIGHT, WORSE * self.calibration.error)
            if is_right and len(real) < AGAIN * self._calibrated_on:
                return False
        progress(0.0, f"calibrating {len(self.parameters)} parameters on {len(real)} real steps")
        found = calibrate(self.spec, steps, self.parameters, self._own, self._step)
        self._calibrated_on = len(real)
        if present is not None and present <= max(RIGHT, WORSE * found.error):
            return False
        self.calibration = found
        self._set(found.values)
        self.file = replace(self.learn(progress), about=self._about(found))
        return True

    def close(self) -> None:
        """Release the simulator."""
        self.simulator.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _step(self, values: Array, coordinates: Array, action: Array) -> Array:
        self._set({parameter.name: float(value) for parameter, value in zip(self.parameters, values, strict=True)})
        return np.asarray(self.simulator.step_from(coordinates, action).next_coordinates, dtype=np.float64)

    def _error(self, steps: RealTransitions, by: Calibration) -> float:
        """Error of the simulator with calibrated values on real steps."""
        values = np.array([by.values[parameter.name] for parameter in self.parameters])
        return calibrate(self.spec, steps, (), values, self._step).error

    def _about(self, found: Calibration) -> dict[str, Any]:
        return PriorAbout(
            source=self.source,
            parameters=[CalibratedParameter(**vars(parameter)) for parameter in found.parameters],
            real_steps=found.steps,
            error_before=found.error_before,
            error=found.error,
            simulated_steps=self.steps,
        ).model_dump(mode="json")


def _opened(simulator: str | OriginalEnvironment, spec: EnvironmentSpec) -> OriginalEnvironment:
    opened: Any = make(simulator, spec=_named(spec, simulator)) if isinstance(simulator, str) else simulator
    if not callable(getattr(opened, "step_from", None)):
        opened.close()
        raise UnknownEnvironment("expected a simulator that can be set to a state (step_from), got one without it")
    environment: OriginalEnvironment = opened
    return environment


def _named(spec: EnvironmentSpec, simulator: str) -> EnvironmentSpec:
    """The specification as one of the simulator, whose name may differ from the plant's."""
    return spec if ":" in simulator else spec.model_copy(update={"environment": simulator})


def _transitions(real: Sequence[RealStep]) -> RealTransitions:
    columns = (
        np.array([getattr(step, name) for step in real], dtype=np.float64).reshape(len(real), -1)
        for name in ("coordinates", "action", "next_coordinates")
    )
    return RealTransitions(*columns)
