"""``python -m tensorsim`` is the command ``tensorsim``."""

from tensorsim.cli import command

if __name__ == "__main__":
    command()
