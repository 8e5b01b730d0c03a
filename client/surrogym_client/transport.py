"""HttpSurrogate comes here; Api is ready."""

from surrogym_client.api import Api
from surrogym_client.connection import Retries, Timeouts

__all__ = ["Api", "Retries", "Timeouts"]
