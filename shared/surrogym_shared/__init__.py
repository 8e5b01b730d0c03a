"""Code that client and server share: specification, wire models, error codes, and the port of surrogates."""
