"""Conversion between the pydantic models of the API's requests and replies and the server's own objects. Each kind of
resource has a file."""

from surrogym_server.convert.definitions import default_budget, definition_from_spec, stored_definition

__all__ = ["default_budget", "definition_from_spec", "stored_definition"]
