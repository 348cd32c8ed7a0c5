"""Boxes of people per frame -> tracks."""
