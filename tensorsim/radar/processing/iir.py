"""Recursive filters (IIR) along pulses, evaluated block by block as matrix products.

In state-space form the recursion runs over blocks of pulses (Oppenheim and Schafer, *Discrete-Time Signal
Processing*, ch. 6). With the state z at the start of a block of inputs u::

    y = H u + O z,      z' = D u + A z

H is the impulse response, O the response to the initial state, D maps inputs to the state after the block, and A the
initial state to it.

``torchaudio.functional.lfilter`` is not used, for three reasons: a scripted module with it loads only in a process that
has imported torchaudio, since its loop is an operator of that library; it is slower (a fourth-order high-pass of
32768 pulses x 200 range bins, complex64, one thread: 1.3 s against 0.2 s); and its direct form is less accurate in
float32 (1.7e-5 against 2.7e-7 of the input at a cut-off of 0.2 m/s, 4e-4 against 6e-7 at 0.02 m/s).
"""

import torch
from torch import Tensor, nn

BLOCK = 128


def filter_blocks(x: Tensor, impulse: Tensor, free: Tensor, drive: Tensor, step: Tensor) -> Tensor:
    """Filter real x (B, M, C) along M with zero initial state.

    For blocks of L pulses and n states: ``impulse`` (L, L), ``free`` (L, n), ``drive`` (n, L) and ``step`` (n, n) are
    H, O, D and A of the module's docstring.
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
    """A cascade of biquads along pulses with zero initial state; equals ``scipy.signal.sosfilt``.

    Args:
        sections: (sections, 6) rows ``b0 b1 b2 a0 a1 a2`` in SciPy's order; stable.

    Shapes: real (B, M, C) -> (B, M, C), each column filtered along M.

    The state is scaled by the response that it causes (O has orthonormal columns), so that float32 is accurate even
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
        # Row i: response to an input at pulse i of a block, or to a unit of state i, within the block and after it.
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
