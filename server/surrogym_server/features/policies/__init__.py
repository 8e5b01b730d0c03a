"""Storage of trained policies, with their cards, learning curves, evaluations and aliases."""

from surrogym_server.feature import Feature
from surrogym_server.features.policies.routes import router
from surrogym_server.features.policies.service import PolicyService

FEATURE = Feature(router, PolicyService.start)
