"""Learning of a model of Gaussian processes from samples."""
