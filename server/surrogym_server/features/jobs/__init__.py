"""Jobs: people queue trainings and evaluations, and trainer workers (``surrogym work``) run them under leases."""

from surrogym_server.feature import Feature
from surrogym_server.features.jobs.routes import router
from surrogym_server.features.jobs.service import JobService

FEATURE = Feature(router, JobService.start)
