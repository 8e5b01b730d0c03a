"""``surrogym prior``: let a design learn beside a simulator, or beside another surrogate."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from surrogym.cli.errors import CommandError
from surrogym.cli.groups import Output, Service
from surrogym.cli.options import NAMES, Surrogate
from surrogym.cli.printing import prints_aside
from surrogym_shared.states import COMPLETED
from surrogym_shared.terminal import on_interrupt, progress

if TYPE_CHECKING:
    from surrogym_client.transport.api import Api
    from surrogym_client.transport.priors import PriorCalls
    from surrogym_sampler.priors.on_server import ServerPrior
    from surrogym_shared.nouns import RealStep
    from surrogym_shared.terminal import Update
    from surrogym_shared.wire import SurrogateView
    from surrogym_shared.wire.priors import PriorAbout, PriorView

LOOK_SECONDS = 1.0
OTHER = "surrogate:"  # an argument that begins with this prefix names another surrogate, not a simulator
LEAST = 2  # a prior is calibrated on at least this number of real steps
# if a calibrated simulator's error exceeds this share of the changes of state, its calibrated values may be wrong
LACKING = 0.01
# if it exceeds this share, a model that predicts no change at all is better
USELESS = 1.0
# a model of a simulator with a smaller confidence index is said not to be certain
CERTAIN = 0.999


def command(
    context: typer.Context,
    surrogate: Surrogate,
    simulator: Annotated[
        str | None,
        typer.Argument(
            help=f"Simulator that can be set to any state: {NAMES}. Or surrogate:NAME on the same server, or a file "
            "from surrogym export. Leave it out with --drop."
        ),
    ] = None,
    parameter: Annotated[
        list[str] | None,
        typer.Option(
            "--parameter",
            "-p",
            help="Parameter of the simulator to calibrate on the real steps, as NAME or NAME=LOW..HIGH. Without a "
            "range it is half to twice the simulator's own value. May be given several times.",
        ),
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(
            min=10,
            max=2_000,
            help="Steps of the simulator from which its model is learned. [default: 50 for each coordinate and action "
            "entry, 100 to 400; 1,000 if the model is then not certain and the simulator is fast]",
        ),
    ] = None,
    drop: Annotated[bool, typer.Option("--drop", help="Remove the prior, or stop waiting for one.")] = False,
    *,
    service: Service,
    output: Output,
) -> None:
    """Learn beside a rough simulator, or another surrogate.

    The design waits after its initial queries. The command calibrates the named parameters on these real steps, learns
    a model of the simulator, and sends it to the server. From then on the design learns only what the simulator gets
    wrong. It ignores the simulator for each output that it predicts better without. The command follows the design
    until it ends, and calibrates again if new real steps contradict the values. The simulator runs in this process
    alone, and its steps are not counted as real ones.

    Example: surrogym prior arm textbook:Arm --parameter mass=0.5..2 --parameter length

    Example: surrogym prior arm surrogate:arm-of-last-year
    """
    from surrogym_client.transport.priors import PriorCalls

    if drop == (simulator is not None):
        raise CommandError("expected a simulator or --drop, got both" if drop else "expected a simulator, got none")
    with service.connect(context) as api:
        view, calls = api.surrogate(surrogate), PriorCalls(api.connection)
        if simulator is None:
            calls.drop(surrogate)
            output.give({"surrogate": surrogate, "prior": None}, lambda: f"{surrogate} learns without a prior")
            return
        target = _Target(api, calls, view)
        if simulator == OTHER + surrogate:
            raise CommandError(
                f"expected another surrogate as the prior of {surrogate}, got {surrogate} itself: name another one"
            )
        if _is_model(simulator) and (parameter or steps):
            raise CommandError(
                f"--parameter and --steps are for a simulator, and {simulator} is a learned model: leave them out"
            )
        if (file := _file_of(api, simulator)) is not None:
            stored = calls.put(surrogate, file)
            with progress("prior", quiet=output.quiet) as update:
                _give(output, target.fitted(view.round, update), stored)
            return
        with (
            prints_aside(),
            progress("prior", quiet=output.quiet) as update,
            _opened(api, view, simulator, parameter or [], steps, update) as prior,
            on_interrupt(lambda: _as_it_is(surrogate, calls.get(surrogate))),
        ):
            stored, view = target.follow(prior, update)
        _give(output, view, stored)


@dataclass(frozen=True)
class _Target:
    """A surrogate whose prior the command sets, and the server's description of it (``view``) at the start of the
    command."""

    api: Api
    calls: PriorCalls
    view: SurrogateView

    def follow(self, prior: ServerPrior, update: Update) -> tuple[PriorView, SurrogateView]:
        """Set the prior once the initial queries are answered, and again whenever calibration changes it, until the
        design ends. Returns the prior and the surrogate."""
        from surrogym_client.surrogates.waiting import share_of_design, words_of_design

        name, used, fitted = self.view.name, 0, self.view.round
        stored = self.calls.wait(name)
        while True:
            view, present = self.api.surrogate(name), self.calls.get(name)
            if view.phase == "failed":
                raise CommandError(f"the design of {name!r} failed: {view.error}; surrogym status {name} shows more")
            if present.about is None and not present.awaited:
                raise CommandError(f"another command removed the prior of {name!r}: run this command again to set it")
            is_new = view.samples > used and view.samples >= LEAST
            if is_new and (used or not _asked(view)):
                real, used = self._real_steps(), view.samples
                if self._updated(prior, real, update, present) and prior.file is not None:
                    fitted = self.api.surrogate(name).round  # a fit without this prior may have ended meanwhile
                    stored = self.calls.put(name, prior.file.to_bytes())
                continue
            if used and _has_ended(view, fitted):
                return stored, view
            is_waiting = bool(_asked(view)) or not used
            update(share_of_design(view), _waiting(view) if is_waiting else words_of_design(view))
            time.sleep(LOOK_SECONDS)

    def fitted(self, after: int, update: Update) -> SurrogateView:
        """Wait for the fit that follows a new prior, and return the surrogate. Return at once if the surrogate has too
        few samples for a fit. ``after`` is the number of the last round before this fit."""
        view = self.api.surrogate(self.view.name)
        while view.samples >= LEAST and view.round <= after and view.phase != "failed" and not _asked(view):
            update(None, "a model is being fitted")
            time.sleep(LOOK_SECONDS)
            view = self.api.surrogate(self.view.name)
        return view

    def _updated(self, prior: ServerPrior, real: list[RealStep], update: Update, present: PriorView) -> bool:
        """Call ``update`` of the prior. If it can't be calibrated, the error also says how the design can continue."""
        from surrogym_sampler.priors.calibration import NotCalibrated

        try:
            return prior.update(real, update)
        except NotCalibrated as error:
            raise CommandError(f"{error}; {_as_it_is(self.view.name, present)}") from error

    def _real_steps(self) -> list[RealStep]:
        from surrogym_shared.nouns import RealStep

        return [
            RealStep(one.coordinates, one.action, one.next_coordinates, one.reward, one.terminated, one.truncated)
            for one in self.api.samples(self.view.name)
        ]


def _opened(
    api: Api, view: SurrogateView, simulator: str, parameters: list[str], steps: int | None, update: Update
) -> ServerPrior:
    from surrogym_sampler.priors.on_server import ServerPrior

    update(None, f"opening {simulator}, and trying some of its steps")
    try:
        return ServerPrior(api, view.name, simulator, view.spec, parameters, steps=steps)
    except ValueError as error:
        raise CommandError(f"the simulator {simulator} can't be the prior: {error}") from error


def _is_model(source: str) -> bool:
    from surrogym.files import SUFFIX

    return source.startswith(OTHER) or Path(source).suffix == SUFFIX


def _file_of(api: Api, source: str) -> bytes | None:
    """Return the content of another surrogate's file, from the server or from disk; None if the source is a
    simulator."""
    from surrogym.files import SUFFIX, existing
    from surrogym_client.surrogates.transfer import export_surrogate

    if source.startswith(OTHER):
        return export_surrogate(api, source.removeprefix(OTHER)).to_bytes()
    try:
        return existing(source).read_bytes() if Path(source).suffix == SUFFIX else None
    except FileNotFoundError as error:
        raise CommandError(str(error)) from error


def _has_ended(view: SurrogateView, fitted: int) -> bool:
    """Whether a design has ended, has no open queries, and has fitted a model after the round number ``fitted``."""
    return view.phase in COMPLETED and view.round > fitted and not _asked(view)


def _asked(view: SurrogateView) -> int:
    """Return the number of queries that wait for a sampler, or for a sampler's answer."""
    return view.queries.pending + view.queries.leased


def _waiting(view: SurrogateView) -> str:
    from surrogym_sampler.original.loading import sample_command

    awaited = "the sampler's answers" if view.samplers else f"a sampler ({sample_command(view.name, view.environment)})"
    return f"{view.samples} real steps; {_asked(view)} queries wait for {awaited}"


def _as_it_is(name: str, stored: PriorView) -> str:
    if stored.awaited:
        return f"the design of {name} waits for its prior: run the command again, or surrogym prior {name} --drop"
    return f"{name} keeps its prior; it is not calibrated again"


def _give(output: Output, view: SurrogateView, stored: PriorView) -> None:
    result = {"surrogate": view.name, "phase": view.phase, "prior": stored.model_dump(mode="json")}
    output.give(
        result, lambda: "\n".join([*(words_of_prior(stored.about) if stored.about else ()), *words_of_use(view)])
    )


def words_of_prior(about: PriorAbout) -> list[str]:
    """Return lines that describe what a prior was made from: its source, its parameters, and its error."""
    lines = [f"prior: {about.source}"]
    if about.error is not None and about.error > USELESS:
        lines.append(
            "  its errors are larger than the changes themselves: check the units, order and signs of its coordinates "
            "and actions, and the seconds of its step"
        )
    elif about.parameters and about.error is not None and about.error > LACKING:
        lines.append("  it lacks something, or the plant has noise: the values below may stand for what it lacks")
    for one in about.parameters:
        known = f"{one.low:.4g} to {one.high:.4g}" if one.determined else "not determined by these steps"
        lines.append(f"  {one.name:<16} {one.value:<10.4g} {known}")
    if about.error is not None and about.error_before is not None:
        steps = f"on {about.real_steps} real steps"
        lines.append(
            f"  error {about.error_before:.2%} of the changes as it was, {about.error:.2%} calibrated, {steps}"
        )
    if about.failed_steps:
        lines.append(
            f"  it fails at {about.failed_steps} other real steps, which were not used: correct it, or give it a "
            "smaller time step"
        )
    if about.confidence_index is not None and about.confidence_index < CERTAIN:
        lines.append(
            f"  a model of {about.simulated_steps} of its steps is not certain (confidence index "
            f"{about.confidence_index:.4g}), so the design takes more real steps: --steps learns it from more"
        )
    return lines


def words_of_use(view: SurrogateView) -> list[str]:
    """Return a line that lists the outputs whose model uses the prior; empty if there is no model yet."""
    from surrogym_shared.spec import REWARD

    if view.fidelity is None:
        return []
    uses = [one.name for one in view.fidelity.outputs if one.structure.startswith("prior + ")]
    declared = REWARD if view.spec.reward.kind == "declared" else ""
    others = [one.name for one in view.fidelity.outputs if one.name not in (*uses, declared)]
    said = f"outputs that use it: {', '.join(uses) or 'none'}"
    return [said + (f"; without it {', '.join(others)} are predicted better" if others else "")]
