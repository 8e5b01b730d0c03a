"""Commands that need the server; they join ``surrogym`` through an entry-point group."""
