"""Control without training: a policy on a grid of states by value iteration, and rollouts around it at each step."""

from surrogym_server.planning.planner import Planner, planner_of

__all__ = ["Planner", "planner_of"]
