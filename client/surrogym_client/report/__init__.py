"""What a server knows of a surrogate, as one page that needs nothing else."""
