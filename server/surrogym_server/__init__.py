"""The Surrogym server: Gaussian-process surrogates, the design of queries, and virtual environments over HTTP."""
