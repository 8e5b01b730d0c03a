"""One typed method for each route of priors."""

from __future__ import annotations

from surrogym_client.transport import routes
from surrogym_client.transport.connection import Connection
from surrogym_client.transport.routes import parse
from surrogym_shared.wire.priors import PriorView


class PriorCalls:
    """Methods for the routes of a surrogate's prior, a model of what is known before the first real step.

    Every method raises the errors of ``Api``.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def get(self, surrogate: str) -> PriorView:
        """Return what the prior was made from, and whether the design waits for a prior."""
        return self._viewed("GET", self._route(surrogate))

    def put(self, surrogate: str, data: bytes) -> PriorView:
        """Set the model in a surrogate's file (``data``) as the prior.

        Raises:
            InvalidInput: the file has other coordinates, units or actions than the surrogate.
        """
        return self._viewed("PUT", self._route(surrogate), data)

    def wait(self, surrogate: str) -> PriorView:
        """Make the design wait, after its initial queries, until a prior is set."""
        return self._viewed("POST", f"{self._route(surrogate)}:await")

    def drop(self, surrogate: str) -> None:
        """Remove the prior, or let the design continue without waiting for one."""
        self._connection.send("DELETE", self._route(surrogate))

    def _viewed(self, method: str, route: str, data: bytes | None = None) -> PriorView:
        reply = self._connection.send(method, route, data, media_type="application/octet-stream")
        return parse(PriorView, reply, route)

    @staticmethod
    def _route(surrogate: str) -> str:
        return f"{routes.surrogate(surrogate)}/prior"
