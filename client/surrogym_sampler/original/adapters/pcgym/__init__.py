"""Models of pc-gym, each by its name or a file of parameters. ``adapter`` opens them, ``file`` reads the file."""
