"""Options of ``surrogym train``, in groups."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from surrogym.cli.errors import CommandError
from surrogym_shared.kinds import Variant

if TYPE_CHECKING:
    from surrogym_shared.spec import EnvironmentSpec
    from surrogym_trainer.training.closed_loop import LoopSettings
    from surrogym_trainer.training.handover import AuditSettings
    from surrogym_trainer.training.settings import Tracker

Log = Literal["tensorboard", "wandb", "mlflow", "none"]


@dataclass(frozen=True)
class SearchOptions:
    """Options that choose the policy search and its length."""

    algorithm: Annotated[
        str | None,
        typer.Option(
            help="Policy search: fastppo (PPO in compiled code), ppo, a2c, sac, td3, ddpg, dqn (Stable-Baselines3), "
            "cmaes, planner (plans each action with the model, nothing is trained), or one from an installed package. "
            "[default: fastppo; ppo if --log, --set or --start-from needs it, or if the specification has the paper's "
            "preset]",
            show_default=False,
        ),
    ] = None
    steps: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Virtual steps to train for, summed over all rounds of --improve. Steps in which a round only "
            "collects the states that the policy visits are not included. [default: from the algorithm]",
        ),
    ] = None
    num_envs: Annotated[
        int | None,
        typer.Option(
            min=1, help="Number of virtual environments that step together. [default: from the specification]"
        ),
    ] = None
    chosen: Annotated[
        list[str] | None,
        typer.Option("--set", help="Hyperparameter of the algorithm, as NAME=VALUE. May be given several times."),
    ] = None
    seed: Annotated[int, typer.Option(min=0, help="Seed of the policy and of the virtual environment.")] = 0
    limits: Annotated[
        list[str] | None,
        typer.Option(
            "--limit",
            help="Limit that a planner keeps, such as level<=11 or x+0.3*v<=1, besides those of the specification. May "
            "be given several times. Only with planner.",
        ),
    ] = None
    integral: Annotated[
        list[str] | None,
        typer.Option(
            help="Coordinate whose error from the set point of the declared reward the policy also sees, summed over "
            "the episode. So it holds the set point with a weaker pump or an offset. May be given several times. Not "
            "with planner."
        ),
    ] = None

    def hyperparameters(self) -> dict[str, Any]:
        """Return the hyperparameters of ``--set`` by name, with the limits. Values are parsed as JSON, or are text if
        that fails."""
        found: dict[str, Any] = {}
        for pair in self.chosen or []:
            name, equals, value = pair.partition("=")
            if not (name and equals):
                raise CommandError(f"--set: expected NAME=VALUE, got {pair!r}")
            try:
                found[name] = json.loads(value)
            except ValueError:
                found[name] = value
        planned = (self.algorithm or "").lower() == "planner"
        if planned and self.steps is not None:
            raise CommandError(
                "--steps: expected no virtual steps with --algorithm planner, because nothing is trained, got "
                f"{self.steps}"
            )
        if self.limits:
            if not planned:
                raise CommandError(
                    "--limit: expected --algorithm planner, because trained policies keep the limits that the "
                    f"specification declares, got {self.algorithm or 'another search'}"
                )
            found["limits"] = self.limits
        return found


@dataclass(frozen=True)
class SessionOptions:
    """Options of the session that the policy learns in. Each is a field of ``OpenSession``."""

    variant: Annotated[
        Variant | None,
        typer.Option(
            help="How the state moves: by the mean (deterministic), as particles (probabilistic), or along a sampled "
            "function (pathwise). [default: the mean. If the design is not ready, the final training "
            "samples the posterior]"
        ),
    ] = None
    particles: Annotated[
        int | None,
        typer.Option(min=1, help="Number of particles of each virtual environment, for variant probabilistic."),
    ] = None
    spread: Annotated[
        float | None,
        typer.Option(
            help="Initial standard deviation of the particles, as a share of the sampling range. [default: 0.01]"
        ),
    ] = None
    process_noise: Annotated[
        bool,
        typer.Option(
            "--process-noise",
            help="Add the learned noise to the state. [default: on if repeated real steps confirm noise]",
            show_default=False,
        ),
    ] = False
    trust: Annotated[
        float | None,
        typer.Option(
            help="Truncate the episode when an output's predicted standard deviation exceeds TRUST times the "
            "output's standard deviation in the samples. [default: no limit]"
        ),
    ] = None
    penalty: Annotated[
        float | None,
        typer.Option(
            min=0,
            help="Subtract PENALTY predicted standard deviations from each reward. [default: from the specification]",
        ),
    ] = None
    set_points: Annotated[
        list[str] | None,
        typer.Option(
            "--set-point",
            help="Set point of a coordinate, as COORDINATE=VALUE, in the place of the value from which the declared "
            "reward measures the coordinate's error. May be given several times.",
        ),
    ] = None

    def fields(self) -> dict[str, Any]:
        """Return the options that were given, by the names of ``OpenSession``.

        Raises:
            CommandError: an option of particles was given with another variant than ``probabilistic``, or a set point
                is not COORDINATE=VALUE, or two are of one coordinate.
        """
        from surrogym_shared.wire import OF_PARTICLES

        given = {name: value for name, value in vars(self).items() if value is not None and value is not False}
        if pairs := given.pop("set_points", None):
            named = list(map(_set_point, pairs))
            given["set_points"] = dict(named)
            if twice := [name for i, (name, _) in enumerate(named) if name in dict(named[:i])]:
                raise CommandError(f"--set-point: expected one value for each coordinate, got two for {twice[0]}")
        for name in OF_PARTICLES:
            if name in given and self.variant != "probabilistic":
                raise CommandError(
                    f"--{name} works with variant probabilistic alone: give --variant probabilistic as well"
                )
        return given


def _set_point(pair: str) -> tuple[str, float]:
    """Return the coordinate and the value of COORDINATE=VALUE. Raises ``CommandError`` for another text."""
    name, _, value = pair.rpartition("=")
    try:
        return name, float(value)
    except ValueError:
        raise CommandError(f"--set-point: expected COORDINATE=VALUE, such as level=12, got {pair!r}") from None


@dataclass(frozen=True)
class StartOptions:
    """Options for starts and lengths of episodes, for a policy to continue from, and for prolonging the training."""

    start_box: Annotated[
        float | None,
        typer.Option(
            min=0,
            max=1,
            help="Share of episodes that start anywhere in the sampling range, between 0 and 1. The others start "
            "where the specification says. [default: 0.5; 0 if all samples come from a log]",
        ),
    ] = None
    start_visited: Annotated[
        float | None,
        typer.Option(
            min=0,
            max=1,
            help="Share of episodes that start at a state at which a real step was taken, between 0 and 1. Then no "
            "episode starts anywhere in the sampling range unless --start-box is given. Not with cmaes. "
            "[default: 0]",
        ),
    ] = None
    horizon: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Longest episode of the training, in virtual steps. The critic values what would follow. Policies "
            "are still compared over whole episodes. Not with cmaes. [default: the time limit]",
        ),
    ] = None
    start_from: Annotated[Path | None, typer.Option(help="Policy file to continue the training from.")] = None
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
            help="Train in cycles while the imagined return rises, then refine the policy from the declared starts. "
            "Only with fastppo. [default: on if --steps is not given]",
            show_default=False,
        ),
    ] = None

    def learned(self) -> EnvironmentSpec | None:
        """Return the specification that the policy of ``--start-from`` was trained for, from its card; None without
        one.

        Raises:
            UnusablePolicy: the file is not a policy, or its card can't be read.
            FileNotFoundError: there is no such file.
        """
        from surrogym_trainer.policies.files import card_of_policy

        return None if self.start_from is None else card_of_policy(self.start_from).spec


@dataclass(frozen=True)
class LoopOptions:
    """Options of the closed loop, which takes real steps between trainings, and of the audit."""

    improve: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Real steps to add in each round, at states that the policy visits; 0 trains without rounds. Rounds "
            "end when the model is certain at these states, or when the design is ready. This needs a running "
            "sampler and enough budget; an admin's token raises the budget. [default: none; if the environment can "
            "only be reset and has more than four coordinates, the policy tries episodes with the rest of the "
            "budget]",
            show_default=False,
        ),
    ] = None
    rounds: Annotated[int, typer.Option(min=1, help="Maximum number of rounds of --improve.")] = 3
    audit: Annotated[
        bool,
        typer.Option(
            "--audit/--no-audit",
            help="Audit the policy: compare a few real steps on its way with the model. They don't count towards the "
            "budget. This needs a running sampler; without one the card says that there was no audit.",
        ),
    ] = True
    audit_steps: Annotated[
        int,
        typer.Option(
            min=2,
            max=256,
            help="Number of real steps with which an audit begins; as many again follow, up to 40 in all, while they "
            "leave the promise undecided. An environment that can only be reset takes at least as many, in rollouts.",
        ),
    ] = 8

    def settings(self) -> LoopSettings | None:
        from surrogym_trainer.training.closed_loop import LoopSettings

        return None if self.improve == 0 else LoopSettings(self.improve or 0, self.rounds)

    def audited(self, seed: int) -> AuditSettings | None:
        from surrogym_trainer.training.handover import AuditSettings

        return AuditSettings(steps=self.audit_steps, seed=seed) if self.audit else None


@dataclass(frozen=True)
class LogOptions:
    """Options for where the training's curves are recorded, and whether the policy is stored on the server."""

    log: Annotated[
        Log | None,
        typer.Option(
            help="Tracker that records the curves of the training. [default: tensorboard with an algorithm of "
            "Stable-Baselines3, none with others]",
            show_default=False,
        ),
    ] = None
    tensorboard: Annotated[
        Path | None, typer.Option(help="Folder for TensorBoard's files. [default: tensorboard, beside the policy]")
    ] = None
    push: Annotated[
        bool,
        typer.Option(
            "--push/--no-push", help="Store the policy on the server as well. To do so later: surrogym policy push."
        ),
    ] = True
    progress_file: Annotated[Path | None, typer.Option(hidden=True, help="Write progress as JSON lines.")] = None

    def tracker(self, algorithm: str | None) -> Tracker | None:
        """Return the tracker of the training's curves; None for no tracker.

        Without ``--log``, it is TensorBoard if its folder is given, or if the algorithm is of Stable-Baselines3.

        Args:
            algorithm: registered name of the policy search; None if none was chosen.
        """
        from surrogym_trainer.training.search import ALGORITHMS

        if self.log is None:
            return "tensorboard" if self.tensorboard is not None or algorithm in ALGORITHMS else None
        return None if self.log == "none" else self.log
