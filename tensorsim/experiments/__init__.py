"""The tables and figures of the paper, each made again by one command: see :mod:`tensorsim.experiments.catalogue`."""
