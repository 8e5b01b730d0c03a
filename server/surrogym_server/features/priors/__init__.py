"""Priors: a model of what is known of an environment beforehand, beside which a design learns the rest."""

from surrogym_server.feature import Feature
from surrogym_server.features.priors.routes import router
from surrogym_server.features.priors.service import PriorService

FEATURE = Feature(router, PriorService.start)
