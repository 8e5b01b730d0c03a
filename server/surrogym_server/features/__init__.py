"""Optional features, one folder each. ``app.FEATURES`` lists them; they import the core and never each other.

A folder has ``FEATURE`` with its routes and its service, its records, and a store with its tables, which
``Storage.part`` opens and a migration creates. Its tests are in ``tests/server/features``, with a file
``allowed.json`` that lists the roles that may call each route.
"""
