"""Conversion of what random steps showed about a simulator to a drafted specification, with questions to a person."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydantic import ValidationError

from surrogym_sampler.original.adapters import open_simulator
from surrogym_sampler.original.describing.counting import Counted
from surrogym_sampler.original.describing.exploring import (
    RESETS,
    STEPS,
    Seen,
    explore,
    moved_by,
    require_coordinates,
    require_numbers,
)
from surrogym_sampler.original.describing.expressing import express, names_in, shown_by_itself
from surrogym_sampler.original.describing.probing import EXACT, Probed, probe
from surrogym_sampler.original.describing.ranges import FASTER, Ranges
from surrogym_sampler.original.describing.rewarding import known_reward
from surrogym_sampler.original.errors import UnknownEnvironment
from surrogym_sampler.original.protocol import Array
from surrogym_sampler.original.simulator import Variable
from surrogym_sampler.original.state_parts import VELOCITY
from surrogym_shared.faults import first_fault
from surrogym_shared.spec import (
    MAX_DIMENSIONS,
    DeclaredReward,
    EnvironmentSpec,
    ObservationEntry,
    Reward,
    Term,
    limits,
)


def words_of_reward(reward: DeclaredReward) -> str:
    """Return in words what kind of function a declared reward is."""
    bonus = reward.terms[0]
    if bonus.when:
        several = f"{len(bonus.when)} thresholds of quantities of the state, all met at once,"
        return "a threshold of a quantity of the state" if len(bonus.when) == 1 else several
    return (
        "an ellipsoid of quantities of the state"
        if bonus.shape == "ball"
        else "a quadratic function of coordinates and actions"
    )


def words_of_access(probed: Probed, fixed: str) -> str:
    """Return a sentence about the states in which an environment can begin.

    Args:
        probed: results of repeated steps.
        fixed: the sentence for an environment that can't be set to a state.
    """
    if not np.isfinite(probed.set_error):
        return fixed
    if not probed.settable:
        return (
            f"a step from a set state differs from the same step within an episode by {probed.set_error:.2g} of "
            "its range: the environment has memory that can't be set, so it can only be reset"
        )
    noise = f"; two steps from one state differ by {probed.repeat_error:.2g}" if probed.noisy else ""
    same = "that of an episode" if probed.set_error <= EXACT else f"that of an episode within {probed.set_error:.2g}"
    return f"it can be set to any state: a step from there is {same}{noise}"


def listed(names: Sequence[str]) -> str:
    """Return the names separated by commas."""
    return ", ".join(names)


MOSTLY = 0.5  # if this share of the random steps has the same reward, a person is asked to declare the reward
PLACES = 300  # number of random states that are set to read their observations; no step is taken
UNKNOWN_LIMIT = 200  # assumed time limit of an episode, if the simulator has none


@dataclass(frozen=True)
class Description:
    """A drafted specification, with the steps that it is based on.

    Attributes:
        spec: the specification.
        found: findings about the environment, one sentence each.
        asked: questions that only a person can answer, one sentence each.
        steps: number of real steps that were taken.
        resets: number of resets.
        pays: whether the environment has a reward of its own.
    """

    spec: EnvironmentSpec
    found: tuple[str, ...]
    asked: tuple[str, ...]
    steps: int
    resets: int
    pays: bool = True

    def words(self) -> list[str]:
        """Return lines for the terminal: the real steps, the findings, and the questions to a person."""
        took = f"{self.spec.environment}: described by {self.steps} real steps and {self.resets} resets"
        return [took, *(f"  found: {line}" for line in self.found), *(f"  to decide: {line}" for line in self.asked)]

    def text(self) -> str:
        """Return a JSON document with the findings, the questions to a person, and the specification."""
        return json.dumps(
            {
                "real_steps": self.steps,
                "resets": self.resets,
                "found": self.found,
                "asked": self.asked,
                "specification": self.spec.model_dump(mode="json"),
            },
            indent=2,
        )


def describe(name: str, steps: int = STEPS, seed: int = 0) -> Description:
    """Draft the specification of an environment that an adapter can open.

    Args:
        name: a Gymnasium id, ``dm_control:DOMAIN-TASK``, ``pcgym:MODEL`` or ``fmu:PLANT.fmu``.
        steps: number of real steps of random episodes. Some more steps check the findings.
        seed: seed of the random actions.

    Raises:
        UnknownEnvironment: no adapter knows the name, or no specification can express the environment.
        StepFailed: the environment failed at a reset or a step; the message has the number of real steps.
        DescriptionInterrupted: Ctrl-C was pressed; the exception has the number of real steps so far.
    """
    counted = Counted(open_simulator(name), name)
    try:
        described = _described(name, counted, steps, np.random.default_rng(seed))
    except (UnknownEnvironment, ValidationError) as error:
        said = (
            f"{name} does not fit into a specification: {first_fault(error)}"
            if isinstance(error, ValidationError)
            else str(error)
        )
        took = f"; this took {counted.steps} real steps" if counted.steps else ""
        raise UnknownEnvironment(f"{said}{took}") from error
    except KeyboardInterrupt:
        raise DescriptionInterrupted(counted.steps) from None
    finally:
        failed = counted.close()
    return replace(described, found=(*described.found, *failed))


def _described(name: str, counted: Counted, steps: int, rng: np.random.Generator) -> Description:
    """Draft the specification of an open environment. Arguments and errors are those of ``describe``."""
    simulator = counted.simulator
    seen = explore(counted, steps, rng)
    lived = ~seen.ended_at_once
    require_numbers(name, (seen.starts, seen.states[lived], seen.next_states[lived]), seen.rewards[lived])
    probed = probe(counted, seen, rng) if simulator.settable else Probed(np.inf, 0.0, 0.0)
    drafted = _Draft(name, counted, seen, probed)
    spec = drafted.spec(rng)
    if (reward := drafted.known_reward(spec, rng)) is not None:
        spec = spec.model_copy(update={"reward": reward})
    found, asked = drafted.found(spec, steps), drafted.asked(spec)
    return Description(spec, found, asked, counted.steps, counted.resets, simulator.pays)


class DescriptionInterrupted(KeyboardInterrupt):
    """Ctrl-C interrupted a description; ``steps`` is the number of real steps taken by then."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps


class _Draft:
    """The draft of one simulator's specification, its findings and its questions."""

    def __init__(self, name: str, counted: Counted, seen: Seen, probed: Probed) -> None:
        self._name, self._counted, self._seen, self._probed = name, counted, seen, probed
        self._simulator = counted.simulator
        lived = ~seen.ended_at_once
        self._all = np.concatenate([seen.starts, seen.states[lived], seen.next_states[lived]])
        self._kept = self._chosen()
        require_coordinates(name, len(self._kept), len(seen.rewards))

    def spec(self, rng: np.random.Generator) -> EnvironmentSpec:
        """Return the specification. The entries of its observation are terms of the coordinates, fitted to the
        simulator's observations; ``rng`` draws states for the fit."""
        variables = [self._simulator.variables[i] for i in self._kept]
        ranges = Ranges(self._simulator, self._seen, self._probed, self._all)
        coordinates = tuple(ranges.coordinate(i) for i in self._kept)
        frame = EnvironmentSpec(
            environment=self._name,
            coordinates=coordinates,
            observation=(ObservationEntry(name="unknown", term=Term.constant(0)),),
            action=self._simulator.action,
            start={c.name: ranges.start(i, c) for i, c in zip(self._kept, coordinates, strict=True)},
            termination="learned" if self._seen.terminated.any() else (),
            sampling_period=self._simulator.period,
            time_limit=self._seen.limit or self._simulator.time_limit or UNKNOWN_LIMIT,
            query="step" if self._probed.settable else "rollout",
            snapshots=self._simulator.saves and not self._simulator.settable,
            reward=Reward(timing="auto"),
        )
        observation = self._observation(frame, variables, rng)
        return EnvironmentSpec.model_validate({**frame.model_dump(), "observation": observation})

    def known_reward(self, spec: EnvironmentSpec, rng: np.random.Generator) -> DeclaredReward | None:
        """Return a formula that gives every reward exactly, so that the specification can declare it; None if none is
        found."""
        usable = self._simulator.pays and self._probed.settable and not self._probed.noisy
        return known_reward(self._counted, self._seen, self._kept, spec, rng) if usable else None

    def found(self, spec: EnvironmentSpec, steps: int) -> tuple[str, ...]:
        """Return the findings, one sentence each; ``steps`` is the number of random steps."""
        probed, kept = self._probed, set(spec.coordinate_names)
        still = [v.name for v in self._simulator.variables if v.name not in kept | probed.shifts]
        kinds = {kind: [c.name for c in spec.coordinates if c.kind == kind] for kind in ("angle", "constant")}
        lines = [
            f"{len(kept)} coordinates describe the state; {steps} random steps and {RESETS} resets showed their ranges",
            words_of_access(probed, self._simulator.fixed),
            *self._simulator.notes,
        ]
        if probed.shifts:
            lines.append(f"a shift of {listed(sorted(probed.shifts))} changes nothing, so it is left out")
        if kinds["angle"]:
            lines.append(
                f"a whole turn of {listed(kinds['angle'])} changes nothing, so it is an angle, shown by its cosine or "
                "sine"
            )
        if drawn := [name for name in kinds["constant"] if name not in self._simulator.scheduled]:
            lines.append(f"{listed(drawn)}: constant within an episode, and drawn again at each reset")
        if not probed.stays:
            lines.append(
                f"{probed.leaving:.0%} of the steps from random states within the declared limits led far outside: the "
                "sampling ranges are those that random actions reached, with a margin"
            )
        if isinstance(spec.reward, DeclaredReward):
            lines.append(
                f"{words_of_reward(spec.reward)} explains every reward, so it is declared: no query is spent on it"
            )
        if still:
            lines.append(f"left out, because it never moved or repeats another variable: {listed(still)}")
        if self._too_many:
            lines.append(
                f"the observation has {self._too_many} entries, more than {MAX_DIMENSIONS}: the policy observes the "
                "coordinates instead"
            )
        elif self._left_out:
            lines.append(
                f"entries {listed([str(i) for i in self._left_out])} of the environment's observation are not sums "
                "of 1, q, sin(q) and cos(q): the policy observes the coordinates instead"
            )
        return tuple(lines)

    def asked(self, spec: EnvironmentSpec) -> tuple[str, ...]:
        """Return the questions about ``spec`` that only a person can answer, one sentence each."""
        guessed = [
            c.name
            for i, c in zip(self._kept, spec.coordinates, strict=True)
            if c.kind == "linear" and not (self._simulator.variables[i].limited and self._probed.stays)
        ]
        ended, lines = int(self._seen.terminated.sum()), list[str]()
        if guessed:
            motions = {v.name: v.motion for v in self._simulator.variables}
            more = f"{FASTER:g} times that for speeds" if "speed" in map(motions.get, guessed) else "some more"
            lines.append(
                f"sampling range of {listed(guessed)}: does it cover the states that a good policy visits? It covers "
                f"what random actions reached, and {more}; the design never queries outside it"
            )
        if self._unmoved:
            lines.append(
                f"{listed(self._unmoved)}: no random action moved it. If nothing can, declare it constant and leave "
                "its velocity out; otherwise give the range of its velocity"
            )
        if ended:
            lines.append(
                f"termination: {ended} of {len(self._seen.rewards)} steps ended an episode. It is learned from these; "
                "an inequality that you declare saves real steps"
            )
        else:
            paid = ", and what an end pays" if isinstance(spec.reward, DeclaredReward) else ""
            lines.append(f"termination: no step ended an episode. If some states should end it, declare them{paid}")
        if scheduled := listed([name for name in spec.coordinate_names if name in self._simulator.scheduled]):
            lines.append(
                f"start of {scheduled}: a schedule sets it in an original episode. A virtual episode keeps one value, "
                "drawn from those of the schedule. Widen the start if a policy should follow other values"
            )
        if self._seen.limit is not None and self._seen.limit != self._simulator.time_limit:
            declared = self._simulator.time_limit
            instead = "declares none" if declared is None else f"declares {declared} steps"
            lines.append(
                f"time_limit: all random episodes ended after exactly {self._seen.limit} steps, so this is the limit; "
                f"the environment {instead}"
            )
        elif self._simulator.time_limit is None:
            lines.append(f"time_limit: the environment declares none; {UNKNOWN_LIMIT} steps are assumed")
        lines.append(
            "success: when does an episode count as solved? Without a criterion, evaluations report returns only"
        )
        if not isinstance(spec.reward, DeclaredReward):
            lines.append(self._asked_of_reward())
        return (*lines, *self._simulator.questions)

    def _asked_of_reward(self) -> str:
        if not self._simulator.pays:
            return "reward: the environment has none. Declare one (kind 'declared') before you register it"
        values, counts = np.unique(self._seen.rewards, return_counts=True)
        usual, often = float(values[counts.argmax()]), int(counts.max())
        if often < MOSTLY * counts.sum():
            return "reward: it is learned; a reward that you declare needs no real steps (kind 'declared')"
        return (
            f"reward: {often} of {counts.sum()} random steps paid exactly {usual:g}. A design with few real steps may "
            "see no other reward and take it for constant: declare it (kind 'declared'), or raise --initial"
        )

    def _chosen(self) -> list[int]:
        """Return the indices of the variables that become coordinates: those that move or differ between episodes.
        Variables that repeat another one, or whose shift changes nothing, are left out."""
        kept: list[int] = []
        unmoved = {f"{name}{VELOCITY}" for name in self._unmoved}
        for i, variable in enumerate(self._simulator.variables):
            repeats = variable.motion == "held" and any(np.allclose(self._all[:, i], self._all[:, k]) for k in kept)
            moves = moved_by(self._all[:, i]) > 0 or variable.name in unmoved | set(self._simulator.scheduled)
            if moves and not repeats and variable.name not in self._probed.shifts:
                kept.append(i)
        return kept

    @property
    def _unmoved(self) -> list[str]:
        """Names of the joints that no random action moved although they can move: each reset gave them another
        position."""
        moved = (self._seen.states != self._seen.next_states).any(0)
        differs = moved_by(self._seen.starts) > 0
        return [
            v.name
            for v, m, d in zip(self._simulator.variables, moved, differs, strict=True)
            if v.motion in ("slide", "turn") and d and not m
        ]

    def _observation(
        self, frame: EnvironmentSpec, variables: Sequence[Variable], rng: np.random.Generator
    ) -> list[ObservationEntry]:
        places, observed = self._observed(frame, rng)
        turning = [v.name for v in variables if v.motion == "turn" or v.name in self._probed.turns]
        entries = express(frame, turning, places, observed)
        angles = {c.name for c in frame.coordinates if c.kind == "angle"}
        self._left_out = [i for i, e in enumerate(entries) if e is None and np.ptp(observed[:, i]) > 1e-6]
        shown, raw = dict[str, ObservationEntry](), set[str]()
        for entry in entries:
            if entry is None:
                continue
            if jumps := angles & _raw(entry.term):
                raw |= jumps
            else:
                shown.setdefault(entry.name, entry)
        for name in frame.coordinate_names:
            if name in raw or name not in {n for entry in shown.values() for n in names_in(entry.term)}:
                shown |= {entry.name: entry for entry in shown_by_itself(name, angle=name in angles)}
        self._too_many = len(shown) if len(shown) > MAX_DIMENSIONS else 0
        if self._too_many:
            return [entry for name in frame.coordinate_names for entry in shown_by_itself(name, angle=name in angles)]
        return list(shown.values())

    def _observed(self, frame: EnvironmentSpec, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return states (n, C), and the simulator's observations in these states (n, D). They are random states of the
        sampling ranges, which ``frame`` has, if the simulator's state can be set, else the states of the explored
        steps."""
        counted = self._counted
        if not (self._simulator.shows and self._probed.settable):
            return self._seen.next_states[:, self._kept], self._seen.observations
        ranges = np.array([limits(c.sampling) for c in frame.coordinates])
        places = rng.uniform(ranges[:, 0], ranges[:, 1], (PLACES, len(ranges)))
        observed = []
        for place in places:
            counted.place(self._kept, place)
            place[:] = counted.read()[self._kept]
            observed.append(counted.observe())
        return places, np.stack(observed)


def _raw(term: Term) -> set[str]:
    """Return the names of the coordinates that a term reads directly, not as cosine or sine. If such a coordinate is an
    angle, the term jumps where the angle is wrapped."""
    return {name for part in term.parts if part.function == "linear" for name in part.weights}
