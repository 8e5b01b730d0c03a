"""Routes of reset, step and rollout, made fast: without FastAPI's processing, and as messages of a WebSocket."""
