"""Checks of an installation, and of a server's conformance to the protocol."""
