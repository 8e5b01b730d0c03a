"""The sampler: original environments, the queries that real steps answer, logs, and what is checked before them."""
