"""Streams: real steps that a machine posts, for ``surrogym watch`` to compare with the model. No model learns them."""

from surrogym_server.feature import Feature
from surrogym_server.features.watching.routes import router
from surrogym_server.features.watching.service import WatchingService

FEATURE = Feature(router, WatchingService.start)
