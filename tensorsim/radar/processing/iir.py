"""Recursive filters along pulses, evaluated block by block as matrix products.

A recursion over single pulses is slow in a tensor library, and torchaudio's compiled one is an operator that a
TorchScript file cannot carry to a process without torchaudio. In state-space form the recursion runs over blocks
of pulses instead (Oppenheim and Schafer, *Discrete-Time Signal Processing*, ch. 6): with the state z at the start
of a block of inputs u,

    y = H u + O z,      z' = D u + A z

where H holds the impulse response, O the outputs that a state leads to, D the state that inputs lead to, and A
takes the state over a whole block.
"""

import torch
from torch import Tensor, nn

BLOCK = 128


def filter_blocks(x: Tensor, impulse: Tensor, free: Tensor, drive: Tensor, step: Tensor) -> Tensor:
    """Filter real x (B, M, C) along M from rest.

    With L pulses a block and n states: ``impulse`` (L, L), ``free`` (L, n), ``drive`` (n, L), ``step`` (n, n), all
    acting from the left; H, O, D and A of the module's docstring.
    """
    pulses, length = x.shape[1], impulse.shape[0]
    blocks = (pulses + length - 1) // length
    padded = torch.nn.functional.pad(x, [0, 0, 0, blocks * length - pulses])
    inputs = padded.unflatten(1, (blocks, length))  # (B, blocks, L, C)
    driven = torch.matmul(drive, inputs)
    state = torch.zeros_like(driven[:, 0])
    states: list[Tensor] = []
    for block in range(blocks):
        states.append(state)
        state = torch.matmul(step, state) + driven[:, block]
    outputs = torch.matmul(impulse, inputs) + torch.matmul(free, torch.stack(states, 1))
    return outputs.flatten(1, 2)[:, :pulses]


class BlockFilter(nn.Module):
    """A cascade of biquads along pulses, from rest; equals ``scipy.signal.sosfilt``.

    Args:
        sections: (sections, 6) rows ``b0 b1 b2 a0 a1 a2`` in SciPy's order; stable.

    Shapes: real (B, M, C) -> (B, M, C), each column filtered along M.

    The state is measured by the response that it causes (O has orthonormal columns), which keeps float32 accurate
    for poles near the unit circle.
    """

    impulse: Tensor
    free: Tensor
    drive: Tensor
    step: Tensor

    def __init__(self, sections: Tensor) -> None:
        super().__init__()
        import numpy as np
        from scipy.signal import sosfilt

        sos = sections.numpy()
        count = len(sos)
        order = 2 * count
        # Row i: what an input at pulse i of a block, or a unit of state i, leads to within the block and after it.
        impulse, drive = sosfilt(sos, np.eye(BLOCK), zi=np.zeros((count, BLOCK, 2)))
        unit = np.eye(order).reshape(order, count, 2).transpose(1, 0, 2)
        free, step = sosfilt(sos, np.zeros((order, BLOCK)), zi=unit)
        drive = drive.transpose(1, 0, 2).reshape(BLOCK, order)
        step = step.transpose(1, 0, 2).reshape(order, order)
        basis, change = np.linalg.qr(free.T)
        matrices = {
            "impulse": impulse.T,
            "free": basis,
            "drive": change @ drive.T,
            "step": change @ np.linalg.solve(change.T, step).T,
        }
        for name, matrix in matrices.items():
            self.register_buffer(name, torch.as_tensor(matrix.copy()), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Real (B, M, C) to (B, M, C)."""
        return filter_blocks(
            x, self.impulse.to(x.dtype), self.free.to(x.dtype), self.drive.to(x.dtype), self.step.to(x.dtype)
        )
