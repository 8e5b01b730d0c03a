"""``surrogym deploy``: write a policy as a controller that runs without Python, or a surrogate as an FMU, which the
server's package writes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import entry_points
from math import isfinite
from pathlib import Path
from shlex import quote
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from surrogym.cli.errors import CommandError
from surrogym.cli.groups import Output, PolicyReading, Service
from surrogym.cli.opening import opener_for_policy
from surrogym.cli.options import NAMES, SpecFile, read_spec
from surrogym_client.runtime.lifetime import terminations_as_interrupts
from surrogym_shared.terminal import progress, say
from surrogym_shared.words import counted

if TYPE_CHECKING:
    import typer

    from surrogym.cli.groups import Service
    from surrogym_sampler.original.episode import Episode
    from surrogym_shared.spec import EnvironmentSpec
    from surrogym_trainer.deployment.controller import Choices, Controller
    from surrogym_trainer.deployment.running import Checked, Comparison
    from surrogym_trainer.deployment.targets import Target
    from surrogym_trainer.policies.card import PolicyCard
    from surrogym_trainer.policies.controller_check import StoredCheck
    from surrogym_trainer.policies.predict import Acting


@dataclass(frozen=True)
class Faults:
    """Options for what a controller does when a measurement is missing or wrong."""

    fallback: Annotated[
        list[float] | None,
        typer.Option(
            help="Action on a fault, one option for each entry. A discrete action needs it. "
            "[default: the continuous action nearest to 0]"
        ),
    ] = None
    timeout: Annotated[
        float | None,
        typer.Option(
            help="Largest age of a measurement in seconds; an older one is a fault. [default: two sampling periods, if "
            "the period is declared]"
        ),
    ] = None
    ranges: Annotated[
        list[str] | None,
        typer.Option(
            "--range",
            help="Readings that a sensor can give, such as level=0:2; others are faults. May be given several times. "
            "[default: the specification's range, widened by its width at each end]",
        ),
    ] = None

    def choices(self, period: float | None) -> Choices:
        """Return the options as settings of a controller.

        Args:
            period: seconds of one step; None takes that of the specification.

        Raises:
            CommandError: an option ``--range`` has not the form NAME=LOW:HIGH.
        """
        from surrogym_trainer.deployment.controller import Choices

        fallback = tuple(self.fallback) if self.fallback else None
        return Choices(fallback, self.timeout, period, dict(map(_range, self.ranges or ())))


@dataclass(frozen=True)
class Checking:
    """Options of ``surrogym deploy`` for the check that a controller acts as its policy does."""

    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="Run the controller beside the policy in the virtual environment, or in --env. A C compiler is needed "
            "for c, arduino and fmu, fmpy for fmu, onnxruntime for onnx. There is no check of st.",
        ),
    ] = False
    env: Annotated[str | None, typer.Option(help=f"Original environment of --check: {NAMES}.")] = None
    episodes: Annotated[
        int,
        typer.Option(
            min=1, help="Number of starts of --check: from each, one episode of the policy and one of the controller."
        ),
    ] = 10

    @contextmanager
    def comparison(self, target: Target, controller: Controller, policy: LocalPolicy) -> Iterator[Comparison | None]:
        """Context with the running controller beside its policy in an environment; None without ``--check``. The
        real steps in an environment of ``--env`` are reported to the server at the end, even after an error.

        Raises:
            CommandError: the target can't run on this machine, or no environment is given.
            CannotCompile: there is no C compiler.
            ModuleNotFoundError: a package that runs the target is missing.
        """
        from surrogym_trainer.deployment.running import Comparison

        if not self.check:
            if self.env is not None:
                raise CommandError(
                    "expected --env together with --check, got --env alone: give --check as well, or leave --env out"
                )
            yield None
            return
        if target.running is None:
            raise CommandError(
                "--check can't run structured text on this machine: leave --check out, and test the program on the PLC"
            )
        if self.env is None and policy.card.surrogate is None:
            raise CommandError("--check needs --env, because no card beside the policy names its surrogate")
        with terminations_as_interrupts(), target.running(controller) as running, self._episode(policy) as episode:
            comparison = Comparison(controller, running, policy.load(), episode)
            try:
                yield comparison
            finally:
                if self.env is not None:
                    policy.enter(comparison)

    @contextmanager
    def _episode(self, policy: LocalPolicy) -> Iterator[Episode]:
        """Context with the original environment of ``--env``, or with the virtual environment without this option.

        Raises:
            PolicyMisfit: the policy was trained for another environment.
        """
        from surrogym_client.transport.http_surrogate import HttpSurrogate
        from surrogym_sampler.original.fitting import check_policy
        from surrogym_trainer.deployment.virtual import VirtualEpisode

        with ExitStack() as stack:
            if self.env is not None:
                episode = opener_for_policy(self.env, policy.given, policy.card, quiet=policy.output.quiet)()
            else:
                api = stack.enter_context(policy.service.connect(policy.context))
                token = policy.service.token_for(policy.context)
                episode = VirtualEpisode(
                    stack.enter_context(HttpSurrogate(api.url, str(policy.card.surrogate), token)), api
                )
            stack.callback(episode.close)
            if (meant := policy.given or policy.card.spec) is not None:
                check_policy(meant, episode.spec)
            yield episode

    def run(self, comparison: Comparison, output: Output) -> Checked:
        """Run the episodes of the check, and return their comparison."""
        from surrogym_trainer.evaluation.evaluator import FIRST_SEED

        seeds = range(FIRST_SEED, FIRST_SEED + self.episodes)
        try:
            with progress("check", quiet=output.quiet) as update:
                return comparison.over(seeds, lambda share: update(share, f"{self.episodes} episodes of each"))
        except KeyboardInterrupt:
            say("interrupted: the controller is written, its check is not; the same command checks it again")
            raise

    def stored(self, checked: Checked, target: str, controller: Controller, card: PolicyCard) -> StoredCheck:
        """Return the result of a check in the form that is written to a file."""
        from surrogym_trainer.policies.controller_check import StoredCheck

        return StoredCheck(
            target=target,
            environment=self.env or f"virtual environment of {card.surrogate}",
            policy=controller.digests["policy"],
            episodes=len(checked.returns),
            steps=checked.steps,
            largest_difference=checked.largest,
            different_actions=checked.different,
            faults=checked.faults,
            mean_return=float(checked.returns.mean()),
            mean_return_of_policy=float(checked.policy_returns.mean()),
            microseconds=checked.microseconds,
        )


@dataclass(frozen=True)
class LocalPolicy:
    """A policy's file on this machine, its card, and the options of the command. ``given`` is the specification from
    the option --spec, or None."""

    path: Path
    card: PolicyCard
    given: EnvironmentSpec | None
    context: typer.Context
    reading: PolicyReading
    service: Service
    output: Output

    def load(self) -> Acting:
        """Load the policy as a function of observations."""
        return self.reading.acting(self.path, self.card, self.given)

    def enter(self, comparison: Comparison) -> None:
        """Report the real steps of a check to the server, as steps of the surrogate."""
        from surrogym.cli.commands.evaluate import enter_steps, ledger_of

        server, token = self.service.server, self.service.token_for(self.context)
        ledger = ledger_of(None, server, self.card, self.path, quiet=self.output.quiet)
        note = "check of a deployed controller, beside its policy"
        enter_steps(ledger, server, token, comparison.begun, comparison.ended, note, quiet=self.output.quiet)


def command(
    context: typer.Context,
    policy: Annotated[
        str,
        typer.Argument(
            metavar="POLICY",
            help="Policy file, or a stored policy such as pendulum@production. For --target fmu also a surrogate.",
        ),
    ],
    target: Annotated[str, typer.Option(help="What to write: c, arduino, fmu, onnx, st.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write: new, empty, or with the same files.")],
    spec: SpecFile = None,
    period: Annotated[
        float | None,
        typer.Option(help="Seconds of one step, if the specification declares no sampling_period."),
    ] = None,
    *,
    faults: Faults,
    checking: Checking,
    reading: PolicyReading,
    service: Service,
    output: Output,
) -> None:
    """Write a policy as a controller for another machine.

    The controller computes the observation from raw measurements, with lags, limits, a timeout and a fallback. Test
    vectors are written beside it.

    Example: surrogym deploy policy.zip --target c --out controller --check

    Example: surrogym deploy pendulum@production --target arduino --period 0.05 --out pendulum_controller

    Example: surrogym deploy pendulum --target fmu --period 0.05 --out twin
    """
    from surrogym_trainer.deployment.reading import controller_of
    from surrogym_trainer.deployment.targets import deploy, target_of
    from surrogym_trainer.policies.controller_check import write_check

    to, named = target_of(target), is_surrogate(policy)
    if named and target != "fmu":
        raise CommandError(
            f"expected a policy for --target {target}, such as policy.zip, pendulum@1 or pendulum@production, got "
            f"{policy!r}; of a surrogate only an fmu can be made"
        )
    if named and (checking != Checking() or faults != Faults() or reading != PolicyReading() or spec is not None):
        raise CommandError("a surrogate as an fmu takes only --out and --period: leave out all options of policies")
    if named:
        twin = write_twin(context, policy, out, period, service)
        output.give(twin, lambda: in_words(twin))
        return
    with _local(policy, read_spec(spec), context, reading, service, output) as local:
        controller = controller_of(
            local.path, local.given, reading.algorithm, trust=reading.trust_policy, choices=faults.choices(period)
        )
        with checking.comparison(to, controller, local) as comparison:
            written = deploy(controller, target, out)
            result: dict[str, Any] = {"target": target, "files": [str(file) for file in written]}
            result["trusted"] = local.card.trusted
            words = [f"{out}: {', '.join(str(file.relative_to(out)) for file in written)}"]
            if not local.card.trusted:
                words.append(_warning(policy, local.card))
            if not isfinite(controller.timeout):
                words.append("no timeout, so a sensor that stops is no fault: --timeout or --period sets one")
            if comparison is not None:
                checked = checking.run(comparison, output)
                stored = checking.stored(checked, target, controller, local.card)
                result["check"] = stored.model_dump(mode="json")
                result["files"].append(str(write_check(out, stored)))
                words += _in_words(checked, stored.environment)
    output.give(result, lambda: "\n".join(words))


@contextmanager
def _local(
    policy: str,
    spec: EnvironmentSpec | None,
    context: typer.Context,
    reading: PolicyReading,
    service: Service,
    output: Output,
) -> Iterator[LocalPolicy]:
    """Context with a policy's file on this machine. A policy on the server is downloaded for the time of the context.

    Raises:
        CommandError: the policy was trained for another specification than the surrogate's, and --spec is missing.
    """
    from surrogym.cli.commands.policy import parsed, stored_card
    from surrogym_trainer.policies.card import write_card
    from surrogym_trainer.policies.files import card_of_policy

    if Path(policy).is_file() or "@" not in policy:
        yield LocalPolicy(Path(policy), card_of_policy(Path(policy)), spec, context, reading, service, output)
        return
    name, which = parsed(policy)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "policy.zip"
        with service.connect(context) as api:
            home, found, card = stored_card(api, name, which)
            if card.spec is None and spec is None:
                raise CommandError(
                    f"expected --spec with the specification that {policy} was trained for, because that of {home!r} "
                    f"differs in {found.differs}"
                )
            path.write_bytes(api.policies.file(home, found.version, "zip"))
        card = card.model_copy(update={"surrogate": name})  # a renewed controller keeps the names of its functions
        write_card(path, card)
        yield LocalPolicy(path, card, spec, context, reading, service, output)


def _warning(policy: str, card: PolicyCard) -> str:
    """Return a warning that a policy's promised return is not trusted, with the commands that test it. The test is an
    audit, which needs the policy's file, so the commands download a stored policy first."""
    stored = "@" in policy and not Path(policy).is_file()
    file = quote("policy.zip" if stored else policy)
    get = f"surrogym policy get {quote(policy)} --out {file}, then " if stored else ""
    named = "" if card.surrogate else " --surrogate NAME"
    doubt = "not trusted" if card.trusted is False else "not judged"
    return (
        f"warning: the policy's promise is {doubt}: {card.reason or 'its card has no audit'}; before a machine obeys "
        f"it: {get}surrogym audit {file}{named}"
    )


def _range(text: str) -> tuple[str, tuple[float, float]]:
    """Parse a range of a sensor given as ``name=low:high``. Raises ``CommandError`` for another form."""
    name, _, ends = text.partition("=")
    low, _, high = ends.partition(":")
    try:
        return name, (float(low), float(high))
    except ValueError as error:
        raise CommandError(f"--range: expected NAME=LOW:HIGH, such as level=0:2, got {text!r}") from error


def _in_words(checked: Checked, environment: str) -> list[str]:
    lines = [
        f"{counted(len(checked.returns), 'episode')} in {environment}, {checked.steps} steps: mean return "
        f"{checked.returns.mean():.6g}, of the policy {checked.policy_returns.mean():.6g}",
        f"actions differ by at most {checked.largest:.1g} of their range",
    ]
    if checked.faults:
        lines.append(f"the controller took its fallback in {counted(checked.faults, 'step')}: --range widens a sensor")
    if checked.microseconds is not None:
        lines.append(f"a decision takes {checked.microseconds:.2g} µs on this machine")
    return lines


# the server's package registers its function that writes a surrogate as an FMU under this entry point group
ENTRY_POINTS = "surrogym.twins"
FILE = ".surrogate"  # suffix of the file of an exported surrogate


def is_surrogate(name: str) -> bool:
    """Whether a name refers to a surrogate: the name of one on a server, or a file that ends in ``.surrogate``. Other
    files, names with ``@`` and names with another ending refer to policies."""
    return name.endswith(FILE) or not (Path(name).is_file() or "@" in name or Path(name).suffix)


def write_twin(
    context: typer.Context, surrogate: str, out: Path, period: float | None, service: Service
) -> dict[str, Any]:
    """Write a surrogate as an FMU into the folder ``out``, and return a description of the FMU as JSON values.

    Args:
        context: context of the command.
        surrogate: name of a surrogate on the server, or its exported file.
        out: a new or empty folder.
        period: seconds of one step; None takes that of the specification.
        service: options of the server.

    Raises:
        CommandError: the extra ``server`` is missing, the surrogate can't be written, or the folder has other files.
    """
    from surrogym_client.surrogates.transfer import export_surrogate

    (entry,) = entry_points(group=ENTRY_POINTS, name="fmu")
    try:
        write = entry.load()
    except ModuleNotFoundError as error:
        raise CommandError(f"a surrogate's FMU needs {error.name}: pip install 'surrogym[server]'") from error
    name = Path(surrogate).stem
    path = out / f"{name}.fmu"
    if out.exists() and (not out.is_dir() or any(one != path for one in out.iterdir())):
        raise CommandError(f"expected a new or an empty folder, got {out} with other files: name another by --out")
    if surrogate.endswith(FILE):
        content = Path(surrogate).read_bytes()
    else:
        with service.connect(context) as api:
            content = export_surrogate(api, surrogate).to_bytes()
    made, there = not out.exists(), path.exists()
    out.mkdir(parents=True, exist_ok=True)
    try:
        written = write(content, path, period)
    except OSError:
        raise
    except Exception as error:  # errors of the server's package, whose classes the client does not import
        if made and not there:
            out.rmdir()
        raise CommandError(str(error)) from error
    return {"target": "fmu", "files": [str(written.path)], "bytes": written.bytes, "binary": written.binary}


def in_words(twin: dict[str, Any]) -> str:
    """Describe a written FMU in a sentence, from the values that ``write_twin`` returned."""
    (path,) = twin["files"]
    native = f"native code for {twin['binary']}" if twin["binary"] else "its sources alone, as no C compiler is here"
    return f"{path}: an FMU of FMI 3.0 with {native}"
