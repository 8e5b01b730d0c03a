"""Where the compiled functions of a model find what they read: the first matrix of its tables."""

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
BLOCK = 32  # lanes computed at once: what is held of them stays in the first cache
