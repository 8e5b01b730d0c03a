"""One typed method for each route of streams."""

from __future__ import annotations

from collections.abc import Sequence

from surrogym_client.transport import routes
from surrogym_client.transport.connection import Connection
from surrogym_shared.wire.watching import AddedSteps, AddSteps, MachineStep, StepPage, StreamedStep


class StepCalls:
    """Methods for the routes of streams: real steps that a machine posts, to be compared with the model.

    Every method raises the errors of ``Api``.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def add(
        self,
        surrogate: str,
        machine: str,
        stream: str,
        first: int,
        steps: Sequence[MachineStep],
        *,
        period: float | None = None,
    ) -> AddedSteps:
        """Append steps to a stream, all or none. A repeat adds nothing.

        Args:
            surrogate: name of the surrogate.
            machine: name of the environment, as in the surrogate's specification.
            stream: name of the stream.
            first: number of the first of the steps in the stream, which begins with 0.
            steps: the steps, oldest first.
            period: seconds between two steps; None if it is not known.

        Raises:
            InvalidInput: the steps are of another machine or in other units, or leave out steps of the stream.
            IdempotencyConflict: another step is stored under the same number.
        """
        body = AddSteps(machine=machine, stream=stream, first=first, period=period, steps=[*steps])
        return self._connection.post(AddedSteps, self._route(surrogate), body)

    def after(self, surrogate: str, id: int = 0, since: float = 0.0) -> list[StreamedStep]:
        """Return the steps after the one with this id that the server stored later than ``since`` (s since 1970), at
        most 1,000; empty if there is none yet."""
        return self._connection.get(StepPage, self._route(surrogate), after=id, since=str(since)).steps

    @staticmethod
    def _route(surrogate: str) -> str:
        return f"{routes.surrogate(surrogate)}/steps"
