"""Denoising of radar maps."""

from tensorsim.enhance.choice import map_denoiser
from tensorsim.enhance.dncnn import DnCNN, MapDenoiser
from tensorsim.enhance.ksvd import KSVD
from tensorsim.enhance.perona_malik import PeronaMalik

__all__ = ["KSVD", "DnCNN", "MapDenoiser", "PeronaMalik", "map_denoiser"]
