"""The design of queries: Latin hypercube, confidence index, occupancy, acquisition, and the rounds of Algorithm 1."""
