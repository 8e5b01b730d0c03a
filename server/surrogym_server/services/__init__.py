"""Use cases: they orchestrate the core, the engine and storage, and know neither HTTP nor the wire."""
