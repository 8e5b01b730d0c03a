"""Jobs: trainings and evaluations that people queue, and that trainer workers (``surrogym work``) run under leases."""

from surrogym_server.feature import Feature
from surrogym_server.features.jobs.routes import router
from surrogym_server.features.jobs.service import JobService

FEATURE = Feature(router, JobService.start)
