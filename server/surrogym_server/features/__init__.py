"""Optional features, one folder each. ``app.FEATURES`` joins them; they import the core and never each other."""
