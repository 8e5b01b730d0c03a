"""A server over the network: every route as a typed method, and a surrogate's sessions as a ``SurrogatePort``."""

from surrogym_client.transport.api import Api
from surrogym_client.transport.connection import Retries, Timeouts
from surrogym_client.transport.http_surrogate import HttpSurrogate, Transport

__all__ = ["Api", "HttpSurrogate", "Retries", "Timeouts", "Transport"]
