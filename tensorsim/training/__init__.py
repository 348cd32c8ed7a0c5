"""Recipes that produced the weights in ``models/``, runnable again: ``tensorsim train``."""
