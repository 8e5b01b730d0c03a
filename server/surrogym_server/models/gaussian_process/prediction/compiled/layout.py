"""Layout of the matrices (tables) in which compiled functions find a model: the entries of the first matrix."""

HEAD = 0  # index of the first matrix in the tables: a single row of indices of other matrices, sizes and flags
NONE = -1  # stored in place of the index of a matrix in the tables, if the model does not have this matrix
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
ENTRIES = HAS_STAGE + 3  # number of entries of the first matrix; the last three say which stages of a step have outputs
BLOCK = 32  # number of lanes (parallel environments) computed at once, so that their data stay in the first-level cache
