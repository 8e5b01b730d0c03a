"""Use cases of the API. They call the core, the engine and the storage, and depend on neither HTTP nor wire types."""
