"""Cameras and boxes."""
