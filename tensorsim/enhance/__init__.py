"""Denoising of radar maps."""

from tensorsim.enhance.dncnn import DnCNN, MapDenoiser

__all__ = ["DnCNN", "MapDenoiser"]
