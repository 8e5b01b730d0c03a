"""The Surrogym server: Gaussian-process surrogates, the adaptive design of queries, and virtual environments over HTTP."""
