"""``python -m tensorsim`` is the command ``tensorsim``."""

from tensorsim.cli import main

if __name__ == "__main__":
    main()
