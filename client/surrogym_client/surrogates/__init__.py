"""Operations on a whole surrogate: wait for its design, advise on it, check its budget, export and import it."""
