"""The family of exact Gaussian processes: feature maps and structure chosen by evidence."""
