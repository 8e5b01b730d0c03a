"""The demo: three processes that talk over HTTP, and what a person sees of them."""
