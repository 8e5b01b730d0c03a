"""Code that client and server share: specification, wire models, error codes, and ``SurrogatePort``, the interface of a
surrogate for trainers."""
