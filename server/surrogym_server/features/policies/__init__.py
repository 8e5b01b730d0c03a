"""Policies: stored with their trainings and evaluations, named by aliases, and returned unchanged."""

from surrogym_server.feature import Feature
from surrogym_server.features.policies.routes import router
from surrogym_server.features.policies.service import PolicyService

FEATURE = Feature(router, PolicyService.start)
