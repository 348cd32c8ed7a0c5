"""Smoothing along time at video rate."""
