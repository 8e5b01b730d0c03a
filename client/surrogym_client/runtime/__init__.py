"""Functions about the process and the machine of the client: imports, signals, versions, and Ray clusters."""
