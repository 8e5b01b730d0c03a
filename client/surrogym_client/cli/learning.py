"""Real steps of an evaluation that a surrogate learns from: asked for before the first one, and kept until stored."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from surrogym_client.original.episodes import Episode
    from surrogym_shared.spec import EnvironmentSpec


@dataclass(frozen=True)
class Learning:
    """A surrogate that exists and is to learn from real steps that are not taken yet.

    Attributes:
        surrogate: its name.
        option: the option that asked for it, for messages.
        spec: the surrogate's specification.
    """

    surrogate: str
    option: str
    spec: EnvironmentSpec

    def checked(self, opener: Callable[[], Episode]) -> Callable[[], Episode]:
        """Return a function that opens an episode, and refuses one whose steps the surrogate can't learn from. It does
        so before the first reset.

        Raises:
            CommandError: the environment has other coordinates than the surrogate, or another kind of action.
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
        from surrogym_client.cli.errors import CommandError
        from surrogym_client.original.fitting import shape_in_words

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


def learning_of(option: str, surrogate: str | None, server: str | None, token: str | None) -> Learning:
    """Ask the server for a surrogate that is to learn from real steps, before the first one is taken.

    Raises:
        CommandError: no surrogate is named, or ``--learn`` was given and the surrogate has no model to compare with.
        SurrogymClientError: the server does not answer, or has no such surrogate.
    """
    from surrogym_client.cli.errors import CommandError
    from surrogym_client.cli.options import connect

    if surrogate is None:
        raise CommandError(f"expected --surrogate with {option}, got none; no real step was taken")
    with connect(server, token) as api:
        view = api.surrogate(surrogate)
    if option == "--learn" and view.fidelity is None:
        raise CommandError(
            f"--learn adds steps that differ from the model, and {surrogate!r} has no model yet: --learn-all adds "
            "every step, without one"
        )
    return Learning(surrogate, option, view.spec)
