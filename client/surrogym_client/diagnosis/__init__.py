"""Whether an installation is in order, and whether a server keeps the protocol."""
