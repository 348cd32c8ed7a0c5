"""Maps of a radar to activities: the picture that a network was trained on, then the network."""

import os

import torch
from torch import Tensor, nn

from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError
from tensorsim.recognition.map_image import MapToImage, ridge_map
from tensorsim.recognition.spgnet import SPGNet
from tensorsim.recognition.spnet import SPNet
from tensorsim.types import RadarMaps

#: What a network can look at, and how many channels that has.
INPUTS = {"doppler": 1, "ridges": 1, "merged": 2}


class ActivityRecognizer(nn.Module):
    """Maps of one radar to the logits of activities (order of ``tensorsim.ACTIVITIES``).

    Args:
        radar: the radar of the maps, which tells what a Doppler bin is in m/s.
        network: pictures (..., C, size, size) in [0, 1] -> logits (..., classes).
        inputs: ``"doppler"``, the Doppler-time map; ``"ridges"``, its ridges alone; ``"merged"``, the range-time map
            after moving target indication and the Doppler-time map as two channels.
        size, speed_m_s, range_db: of the picture, see :class:`MapToImage`.

    Shapes: RadarMaps -> (..., classes). Differentiable by the maps.

    Raises:
        TensorsimError: unknown inputs, or a network with another number of input channels.
    """

    def __init__(
        self,
        radar: RadarConfig,
        network: nn.Module,
        inputs: str = "doppler",
        size: int = 224,
        speed_m_s: float = 3.8,
        range_db: float = 40.0,
    ) -> None:
        super().__init__()
        if inputs not in INPUTS:
            raise TensorsimError(
                f"ActivityRecognizer.inputs: got {inputs!r}, expected one of {', '.join(INPUTS)}"
            )
        channels = getattr(network, "in_channels", INPUTS[inputs])
        if channels != INPUTS[inputs]:
            raise TensorsimError(
                f"ActivityRecognizer: got a network of {channels} input channels, expected {INPUTS[inputs]}, as "
                f"{inputs} has"
            )
        self.inputs = inputs
        self.doppler_picture = MapToImage.doppler(radar, speed_m_s=speed_m_s, size=size, range_db=range_db)
        self.range_picture = MapToImage.range(radar, size=size, range_db=range_db)
        self.network = network

    def forward(self, maps: RadarMaps) -> Tensor:
        """Logits (..., classes)."""
        return self.network(self.picture(maps))

    @torch.jit.export
    def picture(self, maps: RadarMaps) -> Tensor:
        """What the network sees: (..., C, size, size) in [0, 1]."""
        if self.inputs == "ridges":
            bins = maps.doppler_time.shape[-2]
            return self.doppler_picture(ridge_map(maps.ridges, maps.ridge_magnitudes, bins))
        doppler = self.doppler_picture(maps.doppler_time)
        if self.inputs == "doppler":
            return doppler
        return torch.cat([self.range_picture(maps.range_time_mti), doppler], dim=-3)

    @classmethod
    def from_pretrained(
        cls, radar: RadarConfig, source: str | os.PathLike[str] | None = None
    ) -> "ActivityRecognizer":
        """Build the recognizer of a weight file of SPNet or SPGNet, which says what its pictures were.

        Args:
            radar: of the maps to come.
            source: a path of a ``.safetensors``, a name of ``tensorsim models list``, or None for the shipped SPGNet.

        Raises:
            TensorsimError: no such file or name, or a file that does not say what it was trained on.
        """
        from tensorsim.registry import locate
        from tensorsim.weights import read_metadata

        path = locate(source, "SPGNet", "SPNet")
        stated = read_metadata(path)
        networks: dict[str, type[SPNet] | type[SPGNet]] = {"SPNet": SPNet, "SPGNet": SPGNet}
        if stated.get("network") not in networks or "size" not in stated:
            raise TensorsimError(
                f"{path}: its header says {stated or 'nothing'}, expected network (one of {', '.join(networks)}), "
                "size, speed_m_s and range_db"
            )
        return cls(
            radar,
            networks[stated["network"]].from_pretrained(path),
            stated.get("inputs", "doppler"),
            int(stated["size"]),
            float(stated.get("speed_m_s", 3.8)),
            float(stated.get("range_db", 40.0)),
        ).eval()
