"""Layouts of public data sets of videos and captured motion: their files, and how people and labels are named."""
