"""The process and the machine that the client runs on."""
