"""The sampler: a process beside the original environment that answers queries with real steps."""

from surrogym_sampler.queries.settings import Outcome, SamplerReport, SamplerSettings
from surrogym_sampler.queries.worker import Sampler

__all__ = ["Outcome", "Sampler", "SamplerReport", "SamplerSettings"]
