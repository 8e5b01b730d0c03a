"""Sessions in a pool of processes of a Ray cluster, with leases and checkpoints; fits as tasks of the cluster."""
