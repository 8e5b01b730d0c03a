"""``surrogym sample --on-ray N``: options, progress and result of samplers in a Ray cluster."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from surrogym.cli.errors import CommandError

if TYPE_CHECKING:
    from surrogym_sampler.queries.on_ray import RaySamplers
    from surrogym_sampler.queries.settings import SamplerPlan
    from surrogym_sampler.queries.words import Line

ROOM_SECONDS = 30.0  # if samplers have not started after this number of seconds, a remark says so


@dataclass(frozen=True)
class RayOptions:
    """Options of samplers in a Ray cluster."""

    on_ray: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Run N samplers in a Ray cluster. Ray restarts a sampler that dies."),
    ] = None
    ray_address: Annotated[str, typer.Option(metavar="ADDRESS", help="Ray cluster of --on-ray: auto or host:port.")] = (
        "auto"
    )
    ray_resources: Annotated[
        str, typer.Option(metavar="NAME=AMOUNT,...", help="Resources of the cluster that each sampler takes.")
    ] = "CPU=1"
    runtime_env: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="YAML or JSON file with Ray's runtime environment, which brings your code to the machines.",
        ),
    ] = None

    def require_fit(self, *, worker_limits: bool) -> None:
        """Raise ``CommandError`` if options contradict each other.

        Args:
            worker_limits: whether ``--once`` or ``--max-queries`` was given.
        """
        if self.on_ray is None and self.runtime_env is not None:
            raise CommandError(
                "--runtime-env: expected --on-ray N as well, got none: add it, or leave --runtime-env out"
            )
        if self.on_ray is not None and worker_limits:
            raise CommandError(
                "--on-ray: expected --until-done or --time-limit, got --once or --max-queries: replace it"
            )


def samplers_on_ray(options: RayOptions, plan: SamplerPlan) -> RaySamplers:
    """Connect to a Ray cluster, and start samplers in it.

    Raises:
        NoCluster: Ray or its cluster can't be used.
        CommandError: the options for resources or for the runtime environment can't be used.
    """
    from surrogym_client.runtime.ray_cluster import connect
    from surrogym_sampler.queries.on_ray import RaySamplers

    resources = resources_of(options.ray_resources)
    connect(options.ray_address, None if options.runtime_env is None else read_runtime_env(options.runtime_env))
    assert options.on_ray is not None
    try:
        return RaySamplers(plan, options.on_ray, resources)
    except ValueError as error:
        raise CommandError(
            f"--ray-resources: Ray refused them ({' '.join(str(error).split())}): correct them"
        ) from error


def run_samplers(
    samplers: RaySamplers, time_limit: float | None, tell: Callable[[Line], None], say: Callable[[str], None]
) -> None:
    """Wait until all samplers have ended. Stop them after ``time_limit`` seconds, or at Ctrl-C.

    Args:
        samplers: running samplers in a Ray cluster.
        time_limit: seconds; None for no limit.
        tell: called with each answered query.
        say: called with remarks for the terminal.
    """
    begun, told = time.monotonic(), False
    try:
        while True:
            news = samplers.look()
            for line in news.lines:
                tell(line)
            seconds = time.monotonic() - begun
            if news.over:
                return
            if time_limit is not None and seconds >= time_limit:
                samplers.stop()
                return
            if not told and seconds >= ROOM_SECONDS and samplers.waiting:
                told = True
                waiting = f"{samplers.waiting} of {samplers.running} samplers have not started yet"
                say(f"{waiting}; each takes {samplers.takes}{_reason(samplers.lacking())}")
    except KeyboardInterrupt:
        if begun_samplers := samplers.running - samplers.waiting:
            say(f"waiting for the running steps of {begun_samplers} samplers; Ctrl-C again ends them at once")
        samplers.stop()
        raise
    finally:
        samplers.end()


def _reason(lacking: dict[str, float]) -> str:
    """Return the end of a remark about waiting samplers: the free resources that they lack, and what to do about it."""
    from surrogym_sampler.queries.on_ray import amounts

    if not lacking:
        return ""
    way_out = "; --ray-resources CPU=0 takes none, and a smaller --ray-hosts of the server leaves more"
    return f", and the cluster has {amounts(lacking)} free{way_out if 'CPU' in lacking else ''}"


def resources_of(given: str) -> dict[str, float]:
    """Parse resources of a Ray cluster given as text, such as ``CPU=1,robot=1``.

    Raises:
        CommandError: the text is not a list of names with amounts of 0 or more.
    """
    found: dict[str, float] = {}
    for part in given.split(","):
        name, _, amount = part.strip().partition("=")
        try:
            found[name] = float(amount)
        except ValueError:
            found[name] = -1.0
        if not name or not 0 <= found[name] < float("inf"):
            raise CommandError(f"--ray-resources: expected NAME=AMOUNT, such as CPU=1,robot=1, got {given!r}")
    return found


def read_runtime_env(path: Path) -> dict[str, Any]:
    """Read Ray's runtime environment from a YAML or JSON file. Raises ``CommandError`` if the file has another form."""
    import yaml

    try:
        found = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise CommandError(f"--runtime-env: expected YAML or JSON in {path}: {' '.join(str(error).split())}") from error
    if not isinstance(found, dict):
        raise CommandError(f"--runtime-env: expected names with values in {path}, got {type(found).__name__}")
    return found
