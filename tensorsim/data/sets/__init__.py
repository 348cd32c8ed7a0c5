"""Labelled data sets of radar maps: a recipe, its samples, the files they are stored in, and how they are read."""
