"""A Ray cluster behind the ports: sessions in a fixed pool of processes, with leases and checkpoints; fits as tasks."""
