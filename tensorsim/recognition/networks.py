"""All classifiers of map images by name, as experiments and commands choose them."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from torch import nn

from tensorsim.config.documents import find_named
from tensorsim.recognition.adfe_net import ADFENet
from tensorsim.recognition.ccln import CCLN
from tensorsim.recognition.diat_radharnet import DIATRadHARNet
from tensorsim.recognition.fourier_net import FourierNet, GlobalFilterNet
from tensorsim.recognition.mc_gclu import MCGCLU
from tensorsim.recognition.mrw_cn import MRWCN
from tensorsim.recognition.spgnet import SPGNet
from tensorsim.recognition.spnet import SPNet
from tensorsim.recognition.spnet_dense import SPNetDense


@dataclass(frozen=True)
class Classifier:
    """A classifier of map images.

    Attributes:
        title: name in tables.
        make: (classes, channels) -> network; with ``size`` if ``sized``.
        size: height and width of the pictures that its authors use.
        origin: "exact" if all layers are published, "reconstruction" otherwise; and what is left out.
        sized: whether the size of the pictures is part of the network.
    """

    title: str
    make: Callable[..., nn.Module]
    size: int
    origin: str
    sized: bool = False

    def build(self, num_classes: int = 12, in_channels: int = 1, size: int | None = None) -> nn.Module:
        """The network for pictures of ``size`` pixels; None is the size that its authors use."""
        if not self.sized:
            return self.make(num_classes, in_channels)
        return self.make(num_classes, in_channels, size=self.size if size is None else size)


#: By name; those of the comparison in RadHARSimulator V2 first.
CLASSIFIERS: dict[str, Classifier] = {
    "spnet": Classifier("SPNet", SPNet, 224, "exact, with ReLU"),
    "adfe-net": Classifier("TWR-ADFE-Net", ADFENet, 224, "exact, without its enhanced map"),
    "mrw-cn": Classifier("MRW-CN", MRWCN, 224, "reconstruction"),
    "mc-gclu": Classifier("MC-GCLU", MCGCLU, 224, "reconstruction"),
    "diat-radharnet": Classifier("DIAT-RadHARNet", DIATRadHARNet, 224, "reconstruction"),
    "ccln": Classifier("CCLN", CCLN, 224, "reconstruction"),
    "fourier-net": Classifier("FFTBasedNN (V1)", FourierNet, 256, "exact", sized=True),
    "global-filter-net": Classifier(
        "FFTBasedNN improved (V1)", partial(GlobalFilterNet, version="tiny"), 224, "exact", sized=True
    ),
    "spnet-literal": Classifier("SPNet without activations", partial(SPNet, activation="none"), 224, "exact"),
    "spnet-dense": Classifier("SPNet, dense", SPNetDense, 224, "reconstruction"),
    "spgnet": Classifier("SPGNet s2p6", SPGNet, 32, "exact"),
    "spgnet-s2p7": Classifier("SPGNet s2p7", partial(SPGNet, version="s2p7"), 32, "exact"),
    "spgnet-s2p8": Classifier("SPGNet s2p8", partial(SPGNet, version="s2p8"), 32, "exact"),
    "spgnet-s2p9": Classifier("SPGNet s2p9", partial(SPGNet, version="s2p9"), 32, "exact"),
}


def find_classifier(name: str) -> Classifier:
    """The classifier of this name.

    Raises:
        TensorsimError: an unknown name; the message lists the known ones.
    """
    return find_named(CLASSIFIERS, name, "network")
