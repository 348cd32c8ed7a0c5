"""Scatterers -> intermediate-frequency signal: antennas, propagation paths, walls, noise."""
