"""Types of the words that name a choice in a specification or a session, such as the variant of a session."""

from typing import Literal

CoordinateKind = Literal["linear", "angle", "constant"]
LagKind = Literal["change", "value", "action", "steps"]
Function = Literal["one", "linear", "sin", "cos"]  # function phi(q) of a summand in a term of the state q
Relation = Literal["<", "<=", ">", ">="]  # relation of the two sides of an inequality
# Function of the quantities in one term of a declared reward.
RewardShape = Literal["one", "linear", "absolute", "square", "bump", "ball"]
# Whether a reward depends on the state before or after the step. ``auto``: the data decide.
RewardTiming = Literal["before", "after", "auto"]
# Where a query may begin: at any state, at a reset or a state that was saved, or at a reset only.
Access = Literal["any", "snapshot", "reset"]
Side = Literal["lower", "upper"]  # lower or upper end of a range

Variant = Literal["deterministic", "probabilistic", "pathwise"]
AutoresetMode = Literal["next_step", "same_step", "disabled"]
Activation = Literal["tanh", "relu"]  # activation function of the hidden layers of a policy
