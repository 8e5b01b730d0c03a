"""Options of ``surrogym train``, in groups."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

if TYPE_CHECKING:
    from surrogym_client.training.closed_loop import LoopSettings
    from surrogym_client.training.handover import AuditSettings

Variant = Literal["deterministic", "probabilistic", "pathwise"]
Propagation = Literal["mean", "sample"]
Weighting = Literal["inverse_variance", "uniform"]
Log = Literal["tensorboard", "wandb", "mlflow", "none"]


@dataclass(frozen=True)
class SearchOptions:
    """How to search, for how long."""

    algorithm: Annotated[
        str,
        typer.Option(
            help="Search by ppo, a2c, sac, td3, ddpg, dqn (Stable-Baselines3), fastppo (the same PPO in NumPy), cmaes, "
            "gradient, or a package's own."
        ),
    ] = "PPO"
    steps: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Virtual steps, those of all rounds of --improve included; seeing where a round's policy goes comes "
            "on top. [default: from the algorithm]",
        ),
    ] = None
    num_envs: Annotated[
        int | None, typer.Option(min=1, help="Lanes of the session. [default: from the specification]")
    ] = None
    chosen: Annotated[
        list[str] | None,
        typer.Option("--set", help="A hyperparameter of the algorithm as NAME=VALUE; may be given several times."),
    ] = None
    seed: Annotated[int, typer.Option(min=0, help="Seed of policy and virtual environment.")] = 0

    def hyperparameters(self) -> dict[str, Any]:
        """What ``--set`` was given: values are JSON, or text where they are none."""
        from surrogym_client.cli.errors import CommandError

        found: dict[str, Any] = {}
        for pair in self.chosen or []:
            name, equals, value = pair.partition("=")
            if not (name and equals):
                raise CommandError(f"--set: expected NAME=VALUE, got {pair!r}")
            try:
                found[name] = json.loads(value)
            except ValueError:
                found[name] = value
        return found


@dataclass(frozen=True)
class SessionOptions:
    """How the state moves in the session that the policy learns in; each is a field of ``OpenSession``."""

    variant: Annotated[
        Variant | None,
        typer.Option(
            help="The state moves by the mean, as particles, or along a drawn function. [default: the mean. If the "
            "design is not ready, the final training draws from the posterior]"
        ),
    ] = None
    particles: Annotated[int | None, typer.Option(min=1, help="Particles of variant probabilistic.")] = None
    propagation: Annotated[
        Propagation | None, typer.Option(help="How a particle moves: by the mean or by a draw. [default: sample]")
    ] = None
    weighting: Annotated[
        Weighting | None, typer.Option(help="Of the particles' rewards. [default: inverse_variance]")
    ] = None
    spread: Annotated[
        float | None, typer.Option(help="First deviation of particles, as a share of the range. [default: 0.01]")
    ] = None
    process_noise: Annotated[
        bool,
        typer.Option(
            "--process-noise",
            help="Let the learned noise move the state. [default: where repeated real steps confirm noise]",
            show_default=False,
        ),
    ] = False
    trust: Annotated[
        float | None,
        typer.Option(
            help="End an episode where an output's predicted deviation is more than TRUST times its deviation in the "
            "samples. [default: none]"
        ),
    ] = None
    penalty: Annotated[
        float | None, typer.Option(min=0, help="Deviations taken off the reward. [default: the specification's]")
    ] = None

    def fields(self) -> dict[str, Any]:
        """The fields that were given a value. Raises ``CommandError`` where they contradict each other."""
        from surrogym_client.cli.errors import CommandError
        from surrogym_shared.wire import OF_PARTICLES

        given = {name: value for name, value in vars(self).items() if value is not None and value is not False}
        for name in OF_PARTICLES:
            if name in given and self.variant != "probabilistic":
                raise CommandError(f"--{name} is variant probabilistic's: give --variant probabilistic with it")
        return given


@dataclass(frozen=True)
class StartOptions:
    """Where episodes and the policy start, and how long a training may go on."""

    start_box: Annotated[
        float | None,
        typer.Option(
            min=0,
            max=1,
            help="Share of episodes that start anywhere in the sampling range. [default: 0.5; 0 with a log alone]",
        ),
    ] = None
    start_from: Annotated[Path | None, typer.Option(help="Policy file to go on from.")] = None
    trust_policy: Annotated[
        bool,
        typer.Option(
            "--trust-policy",
            help="Unpickle the objects of --start-from. This runs any code in the file. Policies of surrogym train "
            "don't need it.",
        ),
    ] = False
    prolong: Annotated[
        bool | None,
        typer.Option(
            "--prolong/--no-prolong",
            help="As many virtual steps again, once, where the imagined return still rises at the end. Not with cmaes "
            "or gradient. [default: where --steps is not given]",
            show_default=False,
        ),
    ] = None


@dataclass(frozen=True)
class LoopOptions:
    """The closed loop: real steps between trainings."""

    improve: Annotated[
        int,
        typer.Option(
            min=0,
            help="More real queries in each round, where the policy goes, until that is known or the design ready. A "
            "sampler has to be running, and the budget has to hold them; an admin's token raises it.",
        ),
    ] = 0
    rounds: Annotated[int, typer.Option(min=1, help="Rounds of --improve, at most.")] = 3
    audit: Annotated[
        bool,
        typer.Option(
            "--audit/--no-audit",
            help="Compare the model with a few real steps on the policy's way, beyond the budget, before the policy is "
            "handed over. A sampler has to be running; without one the card says that there was no audit.",
        ),
    ] = True
    audit_steps: Annotated[int, typer.Option(min=2, max=256, help="Real steps of an audit.")] = 8

    def settings(self) -> LoopSettings | None:
        from surrogym_client.training.closed_loop import LoopSettings

        return LoopSettings(self.improve, self.rounds) if self.improve else None

    def audited(self, seed: int) -> AuditSettings | None:
        from surrogym_client.training.handover import AuditSettings

        return AuditSettings(steps=self.audit_steps, seed=seed) if self.audit else None


@dataclass(frozen=True)
class LogOptions:
    """Where the curves of a training go."""

    log: Annotated[Log, typer.Option(help="Where the curves of the training go.")] = "tensorboard"
    tensorboard: Annotated[
        Path | None, typer.Option(help="Folder for TensorBoard. [default: tensorboard beside the policy]")
    ] = None
    push: Annotated[
        bool,
        typer.Option(
            "--push/--no-push", help="Store the policy on the server as well; surrogym policy push does so later."
        ),
    ] = True
    progress_file: Annotated[Path | None, typer.Option(hidden=True, help="Write progress as JSON lines.")] = None
