"""Layout of a model's tables for the compiled functions: the entries of the first matrix."""

HEAD = 0  # index of the first matrix: one row of indices of other matrices, sizes and flags
NONE = -1  # index of a matrix that does not exist
(
    OBSERVE,
    FEATURES,
    WIDTH,
    LED_WIDTH,
    AFTER_FEATURES,
    AFTER_WIDTH,
    OUTPUTS,
    PROCESSES,
    LEAD,
    LEADS,
    RULES,
    INVERSE,
    MOVES_OBSERVATION,
    READS_AFTER,
    DECLARED,
    CONDITIONS,
    JUMPS,
    ENDING,
    WARP,
    HAS_STAGE,
) = range(20)
ENTRIES = HAS_STAGE + 3  # number of entries of the first matrix; the last three are flags, one for each stage
BLOCK = 32  # number of lanes computed at once, so that their data stay in the first-level cache
