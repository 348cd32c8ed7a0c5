"""The subcommands of ``tensorsim``: one file each; the code that they run is imported only when they run."""
