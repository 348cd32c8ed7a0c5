"""Repeat one input: ``python -m tests.fuzz KIND SEED``."""

import sys

from tests.fuzz.inputs import run

run(sys.argv[1], int(sys.argv[2]))
