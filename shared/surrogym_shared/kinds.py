"""Kinds of the parts of a specification and of a session, each listed once."""

from typing import Literal

CoordinateKind = Literal["linear", "angle", "constant"]
LagKind = Literal["change", "value", "action", "steps"]
Function = Literal["one", "linear", "sin", "cos"]  # basis function of a summand of a term
Relation = Literal["<", "<=", ">", ">="]  # relation of the two sides of an inequality
RewardShape = Literal["one", "linear", "absolute", "square", "bump", "ball"]  # function of a term in a declared reward
RewardTiming = Literal["before", "after", "auto"]  # the state that a learned reward depends on
Side = Literal["lower", "upper"]  # end of a range

Variant = Literal["deterministic", "probabilistic", "pathwise"]
AutoresetMode = Literal["next_step", "same_step", "disabled"]
Propagation = Literal["mean", "sample"]  # how particles move: by the mean, or by a posterior sample each
Weighting = Literal["inverse_variance", "uniform"]  # how the particles' rewards are averaged
