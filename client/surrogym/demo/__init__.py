"""The demo: three processes that communicate over HTTP, and the output for a person."""
