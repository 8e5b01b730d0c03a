"""Rules that choose the queries of a round: one file for each rule, and their order in ``order``."""

from surrogym_server.sampling.rules.order import ROLLOUT_RULES, STEP_RULES
from surrogym_server.sampling.rules.rule import Rule

__all__ = ["ROLLOUT_RULES", "STEP_RULES", "Rule"]
