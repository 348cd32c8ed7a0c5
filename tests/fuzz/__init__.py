"""Seeded random inputs: everything that is refused is refused in an exception of ours, and what is taken gives numbers.

``python -m tests.fuzz KIND SEED`` repeats one input; ``pytest -m slow tests/fuzz --fuzz-seconds 600`` tries more.
"""
