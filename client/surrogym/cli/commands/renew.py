"""``surrogym renew``: learn a changed machine beside its old surrogate, and replace the policy that it runs."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from surrogym.cli.errors import CommandError
from surrogym.cli.groups import Output, Service
from surrogym.cli.opening import opener_for_policy
from surrogym.cli.options import NAMES, FallbackProgram, Surrogate
from surrogym_client.runtime.lifetime import terminations_as_interrupts
from surrogym_shared.terminal import on_interrupt, progress, say

if TYPE_CHECKING:
    from collections.abc import Callable

    from surrogym_client.transport import Api
    from surrogym_sampler.original.protocol import Environment
    from surrogym_shared.port import SurrogatePort
    from surrogym_shared.spec import Design
    from surrogym_shared.terminal import Update
    from surrogym_shared.wire import PolicyDetail, SurrogateView
    from surrogym_trainer.training.handover import Handover

SHARE = 4  # by default, the renewal takes one of this many real steps of the old design
FEWEST = 4  # but not fewer than this
# the training begins with the old network if this network still has this share of its imagined gain over an untrained
# policy in the new model; with less, a training from it can end far below one from a new network
KEPT = 0.5
PATIENCE_SECONDS = 24 * 3_600.0  # longest time to wait for the real steps of the design


def command(
    context: typer.Context,
    surrogate: Surrogate,
    policy: Annotated[
        str, typer.Option(help="Alias of the policy that the machine runs, such as production, or NAME@production.")
    ],
    env: Annotated[
        str | None,
        typer.Option(
            help=f"The changed environment, in which to take real steps: {NAMES}. [default: the one that the surrogate "
            "names, if opening it runs no file of yours]"
        ),
    ] = None,
    budget: Annotated[
        int | None,
        typer.Option(
            min=FEWEST,
            help="Maximum number of real steps to learn the changed machine, without audits. [default: a quarter of "
            "those of the old design, or as in an interrupted run]",
        ),
    ] = None,
    episodes: Annotated[
        int, typer.Option(min=1, max=100, help="Number of real episodes with the new policy before it stays.")
    ] = 3,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="File for the new policy. [default: the new surrogate's name]")
    ] = None,
    fallback: FallbackProgram = None,
    *,
    service: Service,
    output: Output,
) -> None:
    """Learn a machine that has changed, and replace its policy.

    The old surrogate becomes the prior of a new one, which learns the difference from few real steps. The training
    begins with the network of the old policy if it still has half of its gain. If an audit trusts the new policy, the
    alias moves to it. Then the new policy runs a few real episodes. If these contradict its promised return, the alias
    moves back. An interruption leaves the alias where it was; the same command continues with the new surrogate. This
    needs a token of role admin.

    Example: surrogym renew arm --policy arm@production --env arm:Real
    """
    from surrogym.cli.commands.sample import environment_of
    from surrogym_sampler.original.loading import for_queries
    from surrogym_sampler.queries.query_limits import check_environment

    name, _, alias = policy.rpartition("@")
    if name not in ("", surrogate):
        raise CommandError(f"expected a policy of {surrogate!r}, got {policy!r}: name the same surrogate twice")
    with service.connect(context) as api:
        old = api.policies.get(surrogate, alias)
        if alias not in old.aliases:
            raise CommandError(
                f"expected an alias of a policy of {surrogate!r}, got {alias!r}: give one by surrogym policy alias "
                f"{surrogate}@{old.version} production"
            )
        _require_first(api, surrogate, alias)
        base, target = chain(api, surrogate, alias)
        unconfirmed = old.origin if (old.origin or "").startswith(f"{target}@") and "replaces" in old.settings else None
        if unconfirmed is not None:  # a renewal was killed while its episodes ran
            old = api.policies.get(surrogate, str(old.settings["replaces"]))
            api.policies.put_alias(surrogate, alias, old.version)
        renewal = _Renewal(api, service.token_for(context), surrogate, alias, old, base, target)
        opened, given = environment_of(env, None, base.spec)
        with (
            terminations_as_interrupts(),
            on_interrupt(renewal.words_of_interruption),
            progress("renew", quiet=output.quiet) as update,
            closing(for_queries(opened, 30.0, given, fallback)) as environment,
        ):
            check_environment(base.name, base.spec, environment.spec())
            made = renewal.register(budget, opened)
            path, runs = out or Path(f"{target}.zip"), f"{episodes} episodes in {opened}"
            runs = f"{runs}: at most {episodes * (made.spec.time_limit or 1_000)} real steps"
            if unconfirmed is not None:
                say(f"{unconfirmed} continues with {runs}", quiet=output.quiet)
                handover = renewal.load(path, unconfirmed)
            else:
                learns = f"{target} learns with at most {made.budget} real steps beside {base.name}"
                say(f"{learns}; an audit follows, and {runs}", quiet=output.quiet)
                with _sampling(api, renewal, environment) as check:
                    handover = renewal.train(path, update, check)
            if handover.trusted:
                renewal.put_into_use(path, opened, episodes, fallback, quiet=output.quiet)
        result = renewal.result(path, handover)
    output.give(result, lambda: renewal.words(path, handover))
    if not renewal.stays:
        raise typer.Exit(1)


def _require_first(api: Api, surrogate: str, alias: str) -> None:
    """Raise ``CommandError`` if a surrogate is a renewal of another one whose alias leads to a renewal, because that
    alias, which controllers ask for, would stay where it is."""
    from surrogym_client.errors import UnknownPolicy, UnknownSurrogate

    first, _, number = surrogate.rpartition("-")
    if not first or not number.isdecimal():
        return
    try:
        origin = api.policies.get(first, alias).origin or ""
    except (UnknownPolicy, UnknownSurrogate):
        return
    if origin.startswith(f"{first}-"):
        raise CommandError(
            f"expected {first!r}, of which {surrogate!r} is a renewal, got {surrogate!r}: {first}@{alias} would not "
            f"move; next: surrogym renew {first} --policy {first}@{alias}"
        )


def chain(api: Api, surrogate: str, alias: str) -> tuple[SurrogateView, str]:
    """Return the surrogate whose policy the machine runs, and the name of the next one.

    Renewals of ``arm`` are ``arm-2``, ``arm-3`` and so on. One that was interrupted, or whose policy did not stay, has
    no policy of this alias. A surrogate of such a name that does not have the one before as its prior is no renewal.
    """
    from surrogym_client.transport.priors import PriorCalls

    base, number, known = api.surrogate(surrogate), 2, {one.name for one in api.surrogates()}
    while (target := f"{surrogate}-{number}") in known:
        about = PriorCalls(api.connection).get(target).about
        in_use = any(alias in one.aliases for one in api.policies.list(target))
        if in_use and about is not None and about.source == base.name:
            base = api.surrogate(target)
        elif not in_use and (about is None or about.source == base.name):
            break
        number += 1
    return base, target


def _budget(view: SurrogateView) -> int:
    """Return a quarter of the real steps of a design. Raises ``CommandError`` if it has taken none."""
    if not view.ledger.total:
        raise CommandError(f"{view.name!r} has learned from a log alone: expected --budget with a number of real steps")
    return max(FEWEST, view.ledger.total // SHARE)


def _require_environment(earlier: SurrogateView, env: str) -> None:
    """Raise ``CommandError`` if an earlier run has created the new surrogate for another environment."""
    if earlier.spec.environment != env:
        raise CommandError(
            f"expected {earlier.spec.environment!r}, with which an earlier run began {earlier.name!r}, got {env!r}: "
            f"give --env {earlier.spec.environment}; or begin anew, after surrogym delete {earlier.name}"
        )


@contextmanager
def _sampling(api: Api, renewal: _Renewal, environment: Environment) -> Iterator[Callable[[], object]]:
    """Context in which a sampler answers the queries of the new surrogate. Yields a function that raises the error with
    which the sampler has ended."""
    from surrogym_client.transport import Api
    from surrogym_sampler.queries.settings import SamplerSettings, worker_name
    from surrogym_sampler.queries.worker import Sampler

    settings = SamplerSettings(name=worker_name(), wait_seconds=1.0)
    with Api(api.url, renewal.token) as own, ThreadPoolExecutor(1) as pool:
        sampler = Sampler(own, renewal.target, environment, settings)
        running = pool.submit(sampler.run)
        try:
            yield lambda: running.result() if running.done() else None
        finally:
            sampler.stop()


@dataclass
class _Renewal:
    """One renewal of a policy.

    Attributes:
        surrogate: name of the surrogate whose alias moves.
        alias: the alias.
        old: policy that the alias names at first.
        base: surrogate that is the prior.
        target: name of the new surrogate.
        made: version of the new policy in ``target``.
        version: version of the new policy in ``surrogate``; None if it was not put into use.
        stays: whether the alias names the new policy at last.
        judged: judgement of the real episodes; None if there were none.
    """

    api: Api
    token: str | None
    surrogate: str
    alias: str
    old: PolicyDetail
    base: SurrogateView
    target: str
    made: int = 0
    version: int | None = None
    stays: bool = False
    judged: Handover | None = None

    def register(self, budget: int | None, env: str) -> SurrogateView:
        """Create the new surrogate with the old one as its prior, and return it. One that an earlier run has created
        keeps its real steps.

        Args:
            budget: maximum number of real steps. None: as in the earlier run, or else the default.
            env: name of its environment.

        Raises:
            CommandError: an earlier run has created the new surrogate for another environment.
            SpecConflict: another surrogate has this name.
            InvalidInput: the surrogate can't have a prior.
        """
        from surrogym_client.errors import UnknownSurrogate
        from surrogym_client.surrogates.transfer import export_surrogate
        from surrogym_client.transport.priors import PriorCalls

        try:
            earlier = self.api.surrogate(self.target)
        except UnknownSurrogate:
            design = self._design(budget or _budget(self.api.surrogate(self.surrogate)))
        else:
            _require_environment(earlier, env)
            design = earlier.spec.design
        spec = self.base.spec.model_copy(update={"design": design, "environment": env})
        created, priors = self.api.create_surrogate(self.target, spec).created, PriorCalls(self.api.connection)
        if created or priors.get(self.target).about is None:
            try:
                priors.put(self.target, export_surrogate(self.api, self.base.name).to_bytes())
            except BaseException:
                if created:
                    self.api.delete_surrogate(self.target)
                raise
        view = self.api.surrogate(self.target)
        return view if budget in (None, view.budget) else self.api.patch_surrogate(self.target, budget=budget)

    def _design(self, budget: int) -> Design:
        """Return the design of the old surrogate with another budget."""
        design = self.base.spec.design
        initial = None if design.initial is None else min(design.initial, budget)
        return design.model_copy(update={"budget": budget, "initial": initial})

    def train(self, out: Path, update: Update, check: Callable[[], object]) -> Handover:
        """Wait for the design, train a policy from the network of the old one with its set points, integrals
        and limits, audit it and store it.

        Args:
            out: file for the policy.
            update: shows the progress.
            check: raises an error if the sampler has failed.
        """
        from surrogym_client.surrogates.waiting import share_of_design, wait_for_design, words_of_design
        from surrogym_client.transport import HttpSurrogate
        from surrogym_trainer.policies.card import limits_in, write_card
        from surrogym_trainer.policies.integrals import with_integrals
        from surrogym_trainer.policies.pushing import push
        from surrogym_trainer.training.audited import AuditedTraining
        from surrogym_trainer.training.cards import card_of
        from surrogym_trainer.training.handover import AuditSettings
        from surrogym_trainer.training.settings import TrainProgress, TrainSettings
        from surrogym_trainer.training.words import words_of

        def look(view: SurrogateView) -> None:
            check()
            update(share_of_design(view), words_of_design(view))

        def record(now: TrainProgress) -> None:
            check()
            update(None, words_of(asdict(now)))

        wait_for_design(self.api, self.target, PATIENCE_SECONDS, look)
        integral = tuple(self.old.settings.get("integral") or ())
        with TemporaryDirectory() as folder, HttpSurrogate(self.api.url, self.target, self.token) as http:
            port = with_integrals(http, integral, self._aimed().get("set_points", {}))
            start = self._network(Path(folder) / "old.zip", port)
            limits = limits_in(self.old.settings)
            settings = TrainSettings(
                algorithm=self._algorithm(),
                start_from=start,
                integral=integral,
                session=self._aimed(),
                hyperparameters={"limits": limits} if limits else {},
            )
            training = AuditedTraining(
                self.api, self.target, port, out, settings, audit=AuditSettings(), progress=record, waiting=look
            )
            result, handover = training.train()
            begun = {"start_from": start and f"{self.surrogate}@{self.old.version}", "replaces": self.old.version}
            result = replace(result, settings={**result.settings, **begun})
            spec = http.spec()
        card = card_of(result, handover, surrogate=self.target, spec=spec, url=self.api.url, seed=0, curve=())
        write_card(out, card)
        self.made = push(self.api, out, self.target).policy.version
        return handover

    def load(self, out: Path, policy: str) -> Handover:
        """Download a policy that an earlier run has trained and audited, and return its promise and its audit."""
        from surrogym.cli.commands.policy import parsed, stored_card
        from surrogym_trainer.policies.card import write_card
        from surrogym_trainer.training.handover import Handover

        name, found, card = stored_card(self.api, *parsed(policy))
        out.write_bytes(self.api.policies.file(name, found.version, "zip"))
        write_card(out, card)
        self.made = found.version
        return Handover(card.promise, card.audit, card.trusted is True, card.reason, card.model)

    def put_into_use(self, path: Path, env: str, episodes: int, fallback: str | None, *, quiet: bool) -> None:
        """Move the alias to the new policy, run real episodes, and move it back if they contradict the promise, or if
        the episodes fail or are interrupted.

        Raises:
            CommandError: somebody else has moved the alias meanwhile. It stays where it is.
        """
        from surrogym_trainer.policies.pushing import push

        self._require_alias_at(self.old.version)
        self.version = push(self.api, path, self.surrogate).policy.version
        try:
            self.api.policies.put_alias(self.surrogate, self.alias, self.version)
            self.judged = self._episodes(path, env, episodes, fallback, quiet=quiet)
            self.stays = self.judged.trusted
        finally:
            if not self.stays and self._version_of_alias() == self.version:
                self.api.policies.put_alias(self.surrogate, self.alias, self.old.version)
        self._require_alias_at(self.version if self.stays else self.old.version)
        if self.stays:
            self.api.policies.put_alias(self.target, self.alias, self.made)

    def _version_of_alias(self) -> int | None:
        """Return the version to which the alias leads now; None if it does not exist any more."""
        from surrogym_client.errors import UnknownPolicy

        try:
            return self.api.policies.get(self.surrogate, self.alias).version
        except UnknownPolicy:
            return None

    def _require_alias_at(self, version: int) -> None:
        """Raise ``CommandError`` if the alias does not lead to ``version``, because somebody else has moved it."""
        if (now := self._version_of_alias()) != version:
            got = "no such alias" if now is None else f"version {now}"
            raise CommandError(
                f"expected {self.surrogate}@{self.alias} to lead to version {version}, got {got}: somebody else has "
                f"moved it meanwhile, and it stays there; the new policy is {self.target}@{self.made}"
            )

    def _episodes(self, path: Path, env: str, episodes: int, fallback: str | None, *, quiet: bool) -> Handover:
        """Run real episodes with the new policy, and judge its promise by them."""
        from surrogym.cli.commands.audit import by_episodes
        from surrogym_client.transport import HttpSurrogate
        from surrogym_trainer.evaluation.evaluator import EvaluationSettings
        from surrogym_trainer.policies.card import read_card
        from surrogym_trainer.policies.files import load_policy
        from surrogym_trainer.policies.integrals import with_integrals
        from surrogym_trainer.training.cards import session_of
        from surrogym_trainer.training.handover import Subject

        card = read_card(path)
        opener = opener_for_policy(env, None, card, fallback, quiet=quiet)
        with HttpSurrogate(self.api.url, self.target, self.token) as http:
            port = with_integrals(http, card.integral, card.set_points)
            session = session_of(card, self.api.surrogate(self.target))
            predict = load_policy(path, card.algorithm)
            subject = Subject(self.api, self.target, port, predict, session, card.untrained)
            return by_episodes(subject, env, opener, EvaluationSettings(episodes), quiet=quiet)

    def _aimed(self) -> dict[str, Any]:
        """Return the option of a session with the set points of the old policy; empty if they are the reward's."""
        from surrogym_trainer.policies.card import set_points_in

        points = set_points_in(self.old.settings)
        return {"set_points": points} if points else {}

    def _algorithm(self) -> str | None:
        """Return the policy search of the old policy; None, which is the default search, if it is another program's."""
        from surrogym_trainer.training.search import SEARCHES

        try:
            return SEARCHES.name_of(self.old.algorithm)
        except ValueError:
            return None

    def _network(self, path: Path, port: SurrogatePort) -> Path | None:
        """Write the old policy to a file with which a training can begin. None if it has no network of the same shapes
        that fastppo can train, or if it earns too little in the new model."""
        from surrogym_client.errors import UnknownPolicy
        from surrogym_shared.network import Network
        from surrogym_trainer.evaluation.imagined import imagined_returns
        from surrogym_trainer.policies.card import UnusablePolicy
        from surrogym_trainer.policies.files import load_policy
        from surrogym_trainer.training.fast_ppo.learner import restored
        from surrogym_trainer.training.fast_ppo.search import units_of
        from surrogym_trainer.training.settings import CHECK_EPISODES

        earned, floor, spec = self.old.imagined_return, self.old.untrained, port.spec()
        try:
            path.write_bytes(self.api.policies.file(self.surrogate, self.old.version, "zip"))
            if earned is None or floor is None or not Network.is_at(path):
                return None
            restored(path, spec, units_of(spec))
        except (UnknownPolicy, UnusablePolicy):  # there is only a file of another form, or one of another training
            return None
        old = load_policy(path, self.old.algorithm)
        now = float(imagined_returns(port, old, CHECK_EPISODES, 0, **self._aimed()).mean())
        return path if now - floor >= KEPT * (earned - floor) else None

    def words_of_interruption(self) -> str:
        return (
            f"interrupted; {self.surrogate}@{self.alias} leads to version {self.old.version} as before; the same "
            f"command continues with {self.target}"
        )

    def result(self, out: Path, handover: Handover) -> dict[str, Any]:
        """Return the result as values that JSON can represent."""
        episodes = self.judged
        return {
            "surrogate": self.target,
            "prior": self.base.name,
            "policy": str(out),
            "real_steps": self.api.surrogate(self.target).ledger.model_dump(mode="json"),
            "promise": None if handover.promise is None else handover.promise.model_dump(mode="json"),
            "trusted": handover.trusted,
            "reason": handover.reason,
            "episodes": None if episodes is None else {"trusted": episodes.trusted, "reason": episodes.reason},
            "alias": {"name": self.alias, "version": self.version if self.stays else self.old.version},
            "renewed": self.stays,
        }

    def words(self, out: Path, handover: Handover) -> str:
        from surrogym_trainer.training.words import words_of_handover

        leads, before = f"{self.surrogate}@{self.alias}", f"version {self.old.version}"
        lines = [f"{out}: the policy of {self.target}, whose prior is {self.base.name}", words_of_handover(handover)]
        if self.judged is None:
            lines.append(f"{leads} leads to {before} as before, because the new policy is not trusted")
        elif not self.stays:
            lines.append(f"{leads} leads to {before} again, because real episodes contradict the new promise:")
            lines.append(f"  {self.judged.reason}")
        else:
            lines.append(f"{leads} leads to version {self.version} now: {self.judged.reason}")
            lines.append(f"next: surrogym watch {self.target} --policy {self.alias} --follow")
        return "\n".join(lines)
