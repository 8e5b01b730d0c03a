"""Kinds of the parts of a specification and of a session, each listed once."""

from typing import Literal

CoordinateKind = Literal["linear", "angle", "constant"]
LagKind = Literal["change", "value", "action", "steps"]
Function = Literal["one", "linear", "sin", "cos"]  # basis function of a summand of a term
Relation = Literal["<", "<=", ">", ">="]  # relation of the two sides of an inequality
RewardShape = Literal["one", "linear", "absolute", "square", "bump", "ball"]  # function of a term in a declared reward
RewardTiming = Literal["before", "after", "auto"]  # a learned reward depends on the state before or after the step
Side = Literal["lower", "upper"]  # end of a range

Variant = Literal["deterministic", "probabilistic", "pathwise"]
AutoresetMode = Literal["next_step", "same_step", "disabled"]
Propagation = Literal["mean", "sample"]  # how a particle moves: by the mean, or by its own posterior sample
Weighting = Literal["inverse_variance", "uniform"]  # how the particles' rewards are averaged
