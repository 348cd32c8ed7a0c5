"""Intermediate-frequency signal -> range profiles, Doppler-time maps, ridges, angles."""
