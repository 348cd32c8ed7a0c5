"""Measures of maps: similarity, gait."""
