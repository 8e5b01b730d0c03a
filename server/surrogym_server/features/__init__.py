"""Optional features, one folder each. ``app.FEATURES`` joins them; they import the core and never each other.

A folder has ``FEATURE`` with its routes and its service, its records, and a store with its tables, which
``Storage.part`` opens and a migration creates. Its tests lie in ``tests/server/features``, with a file
``allowed.json`` that says which roles may call its routes.
"""
