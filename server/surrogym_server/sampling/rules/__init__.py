"""Rules that choose the real steps that a round of the design requests (queries): one file for each rule."""

from surrogym_server.sampling.rules.order import ROLLOUT_RULES, STEP_RULES
from surrogym_server.sampling.rules.rule import Rule

__all__ = ["ROLLOUT_RULES", "STEP_RULES", "Rule"]
