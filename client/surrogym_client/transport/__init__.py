"""Access to a server over the network: a typed method for each route, and ``HttpSurrogate`` for a surrogate's
sessions."""

from typing import TYPE_CHECKING

from surrogym_shared.lazy import on_first_use

if TYPE_CHECKING:
    from surrogym_client.transport.api import Api as Api
    from surrogym_client.transport.connection import Retries as Retries
    from surrogym_client.transport.connection import Timeouts as Timeouts
    from surrogym_client.transport.http_surrogate import HttpSurrogate as HttpSurrogate
    from surrogym_client.transport.http_surrogate import Transport as Transport

__getattr__, __all__ = on_first_use(
    __name__, {"api": "Api", "connection": "Retries Timeouts", "http_surrogate": "HttpSurrogate Transport"}
)
