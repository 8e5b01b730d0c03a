"""The HTTP API: each route reads a request, calls one function of a service, and writes the reply."""
