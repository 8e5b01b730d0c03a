"""The commands of ``surrogym``, one file each, with a function ``command``, or ``group`` if it has subcommands."""
