"""Commands of ``surrogym`` that need the server package; they are found through an entry-point group."""
