"""Real steps of an evaluation that a surrogate learns from: the surrogate is checked before the first step, and the
steps are kept in a file until the server has stored them."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from surrogym.cli.errors import CommandError
from surrogym.cli.options import connect, first_model
from surrogym_shared.terminal import say
from surrogym_shared.words import counted

if TYPE_CHECKING:
    from surrogym_client.transport.api import Api
    from surrogym_sampler.original.episode import Episode
    from surrogym_shared.spec import EnvironmentSpec
    from surrogym_shared.wire import AddedSamples, NewSample
    from surrogym_trainer.evaluation.evaluator import Evaluation


@dataclass(frozen=True)
class Learning:
    """A surrogate that will learn from the real steps of an evaluation.

    Attributes:
        surrogate: name of the surrogate.
        option: command-line option that requests the learning, for messages.
        spec: specification of the surrogate.
        server: address of its server; None is the default address.
    """

    surrogate: str
    option: str
    spec: EnvironmentSpec
    server: str | None = None

    def checked(self, opener: Callable[[], Episode]) -> Callable[[], Episode]:
        """Return ``opener`` with a check, before the first reset, that the surrogate can learn from an episode's steps.

        Raises:
            CommandError: raised by the returned function, if the environment has other coordinates than the surrogate,
                or another kind of action.
        """

        def opened() -> Episode:
            episode = opener()
            try:
                self._require(episode.spec)
            except BaseException:
                episode.close()
                raise
            return episode

        return opened

    def _require(self, own: EnvironmentSpec) -> None:
        from surrogym_sampler.original.fitting import shape_in_words

        wanted = self.spec
        if (own.coordinate_names, own.action.kind, own.action.size) != (
            wanted.coordinate_names,
            wanted.action.kind,
            wanted.action.size,
        ):
            raise CommandError(
                f"{self.option}: {self.surrogate!r} can't learn from these steps: expected {shape_in_words(wanted)}, "
                f"got {shape_in_words(own)}; no real step was taken"
            )


def learning_of(option: str, surrogate: str | None, server: str | None, token: str | None, *, quiet: bool) -> Learning:
    """Check on the server, before any real step, that a surrogate can learn from the steps, and return the surrogate.

    Raises:
        CommandError: no surrogate is named, or ``--learn`` was given and the surrogate has no model to compare with.
        SurrogymClientError: the server does not answer, or has no such surrogate.
    """
    if surrogate is None:
        raise CommandError(f"expected --surrogate with {option}, got none; no real step was taken")
    with connect(server, token) as api:
        view = first_model(api, surrogate, quiet=quiet) if option == "--learn" else api.surrogate(surrogate)
    if option == "--learn" and view.fidelity is None:
        raise CommandError(
            f"--learn adds steps that differ from the model, and {surrogate!r} has no model yet: --learn-all adds "
            "every step, without one"
        )
    return Learning(surrogate, option, view.spec, server)


@dataclass
class Steps:
    """Real steps that are being sent to a surrogate.

    Attributes:
        learning: the surrogate.
        samples: the steps.
        file: file with the steps until the server has stored all of them; None without steps, or if no file can be
            written.
        stored: number of steps that the server has confirmed.
        new: number of confirmed steps that the server did not have before.
        waiting: whether there are steps that the server has not confirmed.
        fault: error that prevented the confirmation; empty without one.
    """

    learning: Learning
    samples: list[NewSample]
    file: Path | None = None
    stored: int = 0
    new: int = 0
    waiting: bool = True
    fault: str = ""

    def choose(self, samples: Sequence[NewSample]) -> None:
        """Replace the steps to send by ``samples``, also in the file. Raises ``OSError`` if it can't be written."""
        from surrogym_trainer.evaluation.reporting import as_logged, rewrite_steps

        self.samples = as_logged(self.learning.spec, samples)
        if self.file is not None and self.samples:
            rewrite_steps(self.file, self.learning.spec, self.samples)

    def send(self, api: Api) -> None:
        """Add the steps to the surrogate's samples, and remove their file once the server has confirmed all.

        Raises:
            SurrogymClientError: the server has not confirmed all steps; the file remains.
        """
        if self.samples:
            api.add_samples(self.learning.surrogate, "evaluate", self.samples, purpose="logged", stored=self._count)
        self.waiting = False
        if self.file is not None:
            self.file.unlink(missing_ok=True)

    def require_stored(self) -> None:
        """Raise ``CommandError`` if the server has not confirmed all steps. The message names the file with the steps,
        and the command that sends this file."""
        if self.waiting:
            raise CommandError(self.in_words())

    def in_words(self) -> str:
        """Describe how many steps are stored, which file has all of them, and which command sends it."""
        count = f"{self.stored:,} of {len(self.samples):,} real steps are known to be stored"
        said = f"{self.learning.option}: {self.fault}; {count}" if self.fault else f"{self.learning.option}: {count}"
        if self.file is None:
            return f"{said}, and no file could be written for them"
        where = [] if self.learning.server is None else ["--server", self.learning.server]
        command = ["surrogym", "import", str(self.file), "--to", self.learning.surrogate, *where]
        return f"{said}; all are in {self.file}; to store the others, without storing any twice: {shlex.join(command)}"

    def _count(self, added: AddedSamples) -> None:
        self.stored = len(added.sample_ids)
        self.new = len(added.sample_ids) - added.duplicates


@contextmanager
def kept(learning: Learning | None, policy: Path, result: Evaluation, *, quiet: bool) -> Iterator[Steps | None]:
    """Context that keeps the steps of an evaluation in a file beside the policy until they are sent.

    After an error or Ctrl-C, it prints where the steps are. Yields None if no surrogate learns from the steps.
    """
    from surrogym_trainer.evaluation.reporting import write_steps

    if learning is None:
        yield None
        return
    samples = _learnable(learning.spec, result, quiet=quiet)
    steps = Steps(learning, samples, waiting=bool(samples))
    try:
        steps.file = write_steps(policy, learning.spec, steps.samples) if steps.samples else None
    except OSError as error:
        say(f"the real steps are in no file until the server has stored them: {error}", quiet=quiet)
    try:
        yield steps
    except BaseException:
        if steps.waiting:
            say(steps.in_words())
        raise


def _learnable(spec: EnvironmentSpec, result: Evaluation, *, quiet: bool) -> list[NewSample]:
    """Return the steps of an evaluation that a model can learn from. Print how many are left out because of numbers
    that are not finite or too large."""
    from surrogym_trainer.evaluation.comparing import as_samples, steady, steps_of
    from surrogym_trainer.evaluation.reporting import as_logged, is_storable

    taken = steps_of(result.traces, result.steps)
    sound = [step for step in taken if is_storable(step)]
    if lost := len(taken) - len(sound):
        say(f"left out: {counted(lost, 'real step')} with numbers that are not finite, or too large", quiet=quiet)
    known = [step for step in sound if spec.known(step.coordinates)]
    return as_logged(spec, as_samples(steady(spec, known)))
