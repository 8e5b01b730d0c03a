"""Layout of a model's tables for the compiled functions: the entries of the first matrix."""

HEAD = 0  # place of the first matrix, a row of places of other matrices, sizes and flags
NONE = -1  # in place of a place
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
ENTRIES = HAS_STAGE + 3  # one for each stage
BLOCK = 32  # lanes computed at once, so that their data stay in the first cache
