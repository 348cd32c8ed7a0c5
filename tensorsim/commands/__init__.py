"""The subcommands of ``tensorsim``: one file each; what they run is imported when they run."""
