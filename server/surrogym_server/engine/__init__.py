"""Where work runs and where live sessions are."""
