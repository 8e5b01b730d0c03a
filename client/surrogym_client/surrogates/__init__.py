"""Operations on a whole surrogate: wait for its design, check its budget, move it to a file and back."""
