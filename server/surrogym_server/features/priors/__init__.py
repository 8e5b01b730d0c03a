"""Priors: models known before the first real step, such as of a simulator; a design learns the remaining error."""

from surrogym_server.feature import Feature
from surrogym_server.features.priors.routes import router
from surrogym_server.features.priors.service import PriorService

FEATURE = Feature(router, PriorService.start)
