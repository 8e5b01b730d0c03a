"""The worker beside the original environment, which answers the queries of a design by real steps."""

from surrogym_client.sampler.worker import Outcome, Sampler, SamplerReport, SamplerSettings

__all__ = ["Outcome", "Sampler", "SamplerReport", "SamplerSettings"]
