"""Radar maps to activities: conversion to the image that a network was trained on, then the network."""

import os
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError, check_choice, check_positive
from tensorsim.protocols import check_instance
from tensorsim.recognition.labels import LabelSet
from tensorsim.recognition.map_image import MapToImage, ridge_map
from tensorsim.recognition.spgnet import SPGNet
from tensorsim.recognition.spnet import SPNet
from tensorsim.types import RadarMaps
from tensorsim.weights import read_metadata, save_weights

#: Kinds of input of a network, and their number of channels.
INPUTS = {"doppler": 1, "ridges": 1, "merged": 2}
#: Networks that a weight file can name.
NETWORKS: dict[str, type[SPNet] | type[SPGNet]] = {"SPNet": SPNet, "SPGNet": SPGNet}


def stored_classifier(path: Path) -> tuple[SPNet | SPGNet, dict[str, str]]:
    """The network of a weight file, and the metadata in the header of the file.

    Raises:
        TensorsimError: no such file, or weights of neither network.
    """
    if not path.is_file():
        raise TensorsimError(f"{path}: no such file, expected the weights of a classifier")
    stated = read_metadata(path)
    if stated.get("network") not in NETWORKS or "size" not in stated:
        raise TensorsimError(
            f"{path}: got the metadata {stated or 'none'}, expected network (one of {', '.join(NETWORKS)}), "
            "size, speed_m_s and range_db"
        )
    return NETWORKS[stated["network"]].from_pretrained(path), stated


class ActivityRecognizer(nn.Module):
    """Maps of one radar to the logits of activities, or of classes of your own.

    Args:
        radar: the radar of the maps, for the speed of a Doppler bin in m/s.
        network: images (..., C, size, size) in [0, 1] -> logits (..., classes).
        inputs: ``"doppler"``, the Doppler-time map; ``"ridges"``, its ridges alone; ``"merged"``, the range-time map
            after moving target indication and the Doppler-time map as two channels.
        size, speed_m_s, range_db: of the image, see :class:`MapToImage`.
        class_names: of the network's outputs in their order; by default ``tensorsim.ACTIVITIES``.
        temperature: logits are divided by it for :meth:`probabilities` (Guo et al., "On calibration of modern neural
            networks", ICML 2017).
        either_way: average the logits of the picture and of its copy with approach and retreat exchanged, for networks
            that learnt activities in every heading.

    Shapes: RadarMaps -> (..., classes). Differentiable with respect to the maps.

    Attributes:
        radar, class_names: as given.
        labels: the same as a :class:`LabelSet`.

    Raises:
        TensorsimError: unknown inputs, ``either_way`` with ``"merged"`` ones, a network that is not a module, has
            another number of input channels, or another number of classes than names; maps that are not RadarMaps.
    """

    def __init__(
        self,
        radar: RadarConfig,
        network: nn.Module,
        inputs: str = "doppler",
        size: int = 224,
        speed_m_s: float = 3.8,
        range_db: float = 40.0,
        class_names: Sequence[str] | None = None,
        temperature: float = 1.0,
        either_way: bool = False,
    ) -> None:
        super().__init__()
        check_positive(temperature, "ActivityRecognizer.temperature")
        self.temperature = float(temperature)
        check_choice(inputs, INPUTS, "ActivityRecognizer.inputs")
        if either_way and inputs == "merged":
            raise TensorsimError(
                "ActivityRecognizer.either_way: cannot be used with inputs='merged': range-time maps have no reversed "
                "form"
            )
        self.either_way = bool(either_way)
        check_instance(radar, RadarConfig, "ActivityRecognizer.radar")
        check_instance(network, nn.Module, "ActivityRecognizer.network")
        channels = getattr(network, "in_channels", INPUTS[inputs])
        if channels != INPUTS[inputs]:
            raise TensorsimError(
                f"ActivityRecognizer: got a network of {channels} input channels, expected {INPUTS[inputs]} for "
                f"inputs {inputs!r}"
            )
        self.labels = LabelSet() if class_names is None else LabelSet(tuple(class_names))
        classes = getattr(network, "num_classes", len(self.labels))
        if classes != len(self.labels):
            raise TensorsimError(
                f"ActivityRecognizer: got a network of {classes} classes, expected {len(self.labels)}, one per class "
                "name"
            )
        self.class_names = self.labels.names
        self.radar = radar
        self.inputs = inputs
        self.size, self.speed_m_s, self.range_db = size, speed_m_s, range_db
        self.doppler_picture = MapToImage.doppler(radar, speed_m_s=speed_m_s, size=size, range_db=range_db)
        self.range_picture = MapToImage.range(radar, size=size, range_db=range_db)
        self.network = network

    def forward(self, maps: RadarMaps) -> Tensor:
        """Logits (..., classes)."""
        picture = self.picture(maps)
        logits: Tensor = self.network(picture)
        if self.either_way:
            logits = 0.5 * (logits + self.network(picture.flip(-2)))
        return logits

    @torch.jit.export
    def probabilities(self, maps: RadarMaps) -> Tensor:
        """Calibrated probabilities (..., classes): the softmax of the logits over the temperature."""
        return (self.forward(maps) / self.temperature).softmax(-1)

    @torch.jit.export
    def picture(self, maps: RadarMaps) -> Tensor:
        """Input image of the network: (..., C, size, size) in [0, 1]."""
        if not torch.jit.is_scripting():
            check_instance(maps, RadarMaps, "maps")
        if self.inputs == "ridges":
            bins = maps.doppler_time.shape[-2]
            return self.doppler_picture(ridge_map(maps.ridges, maps.ridge_magnitudes, bins))
        doppler = self.doppler_picture(maps.doppler_time)
        if self.inputs == "doppler":
            return doppler
        return torch.cat([self.range_picture(maps.range_time_mti), doppler], dim=-3)

    @torch.jit.unused
    def save_pretrained(self, path: str | os.PathLike[str], class_names: Sequence[str] | None = None) -> None:
        """Write weights, class names and settings of the pictures, for :meth:`from_pretrained`.

        Args:
            path: ends in ``.safetensors``. Parameters are stored in float16.
            class_names: instead of those of this recognizer.

        Raises:
            TensorsimError: a network that is neither SPNet nor SPGNet, another suffix, or another number of classes.
        """
        labels = self.labels if class_names is None else LabelSet(tuple(class_names))
        name = type(self.network).__name__
        if name not in NETWORKS:
            raise TensorsimError(
                f"save_pretrained: got a network of class {name}, expected one of {', '.join(NETWORKS)}; write others "
                "with tensorsim.weights.save_weights"
            )
        if len(labels) != len(self.labels):
            raise TensorsimError(f"class_names: got {len(labels)}, expected {len(self.labels)}")
        if Path(path).suffix != ".safetensors":
            raise TensorsimError(f"{path}: got the suffix {Path(path).suffix!r}, expected .safetensors")
        save_weights(
            self.network,
            path,
            {
                "network": name,
                "inputs": self.inputs,
                "size": str(self.size),
                "speed_m_s": repr(self.speed_m_s),
                "range_db": repr(self.range_db),
                "class_names": labels.to_text(),
                "temperature": repr(self.temperature),
                "either_way": str(int(self.either_way)),
            },
        )

    @classmethod
    def from_pretrained(
        cls, radar: RadarConfig, source: str | os.PathLike[str] | None = None
    ) -> "ActivityRecognizer":
        """Build the recognizer of a weight file, with the image settings and classes in its metadata.

        Args:
            radar: the radar of the maps.
            source: path of a ``.safetensors`` file, a name from ``tensorsim models list``, or None for the shipped
                SPGNet.

        Raises:
            TensorsimError: no such file or name, or a file without this metadata.
        """
        from tensorsim.registry import locate

        path = locate(source, "SPGNet", "SPNet")
        network, stated = stored_classifier(path)
        names = stated.get("class_names")
        return cls(
            radar,
            network,
            stated.get("inputs", "doppler"),
            int(stated["size"]),
            float(stated.get("speed_m_s", 3.8)),
            float(stated.get("range_db", 40.0)),
            None if names is None else LabelSet.from_text(names).names,
            float(stated.get("temperature", 1.0)),
            stated.get("either_way", "0") == "1",
        ).eval()
