"""Recipes that produced the weights in ``models/``; ``tensorsim train`` runs them again."""
