"""First weights of layers that begin at random."""

from __future__ import annotations

from torch import Tensor, nn


def normal(weight: Tensor, std: float) -> None:
    """Normally distributed weights of a standard deviation; nothing where the tensor holds no numbers.

    A network that is only compared with a file lies on torch's ``meta`` device. Drawing numbers there makes none, but
    loads torch's compiler, which takes longer (1.6 s of processor, once a process) than building the network.
    """
    if not weight.is_meta:
        nn.init.normal_(weight, std=std)


def kaiming_normal(weight: Tensor) -> None:
    """He et al. 2015 for a ReLU, by the outputs; nothing where the tensor holds no numbers, see `normal`."""
    if not weight.is_meta:
        nn.init.kaiming_normal_(weight, mode="fan_out", nonlinearity="relu")
