"""Evidence for the claims of the documentation, reproduced by real runs."""
