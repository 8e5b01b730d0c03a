"""Ten tasks of the study of trust, written before the method was frozen: no part of it is tuned on them."""
