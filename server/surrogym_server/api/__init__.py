"""The HTTP API: routes read the wire, call one service function, and write the wire."""
