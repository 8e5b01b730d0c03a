"""The sampler: it opens and checks original environments, answers a server's queries by real steps, and reads logs."""
