"""The sampler, a process beside the original environment that answers queries with real steps."""

from surrogym_client.sampler.worker import Outcome, Sampler, SamplerReport, SamplerSettings

__all__ = ["Outcome", "Sampler", "SamplerReport", "SamplerSettings"]
