"""The language both sides of Surrogym speak: specification, wire models, error codes, and the port."""
