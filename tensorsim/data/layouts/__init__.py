"""Layouts of public sets of films and captured motion: which files they have, and how people and labels are named."""
