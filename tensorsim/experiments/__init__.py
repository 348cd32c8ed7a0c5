"""The tables and figures of the paper, each reproduced by one command: see :mod:`tensorsim.experiments.catalogue`."""
