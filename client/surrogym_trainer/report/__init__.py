"""A report on a surrogate, as one self-contained page."""
