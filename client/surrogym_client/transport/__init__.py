"""Access to a server over the network: a typed method for each route, and ``HttpSurrogate`` for a surrogate's
sessions."""

from surrogym_client.transport.api import Api
from surrogym_client.transport.connection import Retries, Timeouts
from surrogym_client.transport.http_surrogate import HttpSurrogate, Transport

__all__ = ["Api", "HttpSurrogate", "Retries", "Timeouts", "Transport"]
