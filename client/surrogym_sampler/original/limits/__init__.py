"""Guard of an original environment with declared limits: its fallback controller acts before a limit is left, and
when no action comes."""

from surrogym_sampler.original.limits.episodes import GuardedEpisode
from surrogym_sampler.original.limits.queries import guarded

__all__ = ["GuardedEpisode", "guarded"]
