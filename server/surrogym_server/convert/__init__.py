"""Conversion between wire models and objects of the core, in pairs of functions; one file for each kind of resource."""

from surrogym_server.convert.definitions import default_budget, definition_from_spec, stored_definition

__all__ = ["default_budget", "definition_from_spec", "stored_definition"]
