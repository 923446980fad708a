"""Both scans as one loop over the tokens, with gradients by hand: exact in float64, at any length.

In float32 it shows the error of a plain loop on a badly conditioned case.
"""

import numba
import numpy as np
import torch
from torch import Tensor


def scan_loop(
    name: str, arguments: tuple[Tensor, ...], grad_output: Tensor, reverse: bool, dtype: torch.dtype
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """y, and the gradients of x, dt, A, B, C and D, of the scan that `name` calls."""
    x, dt, A, B, C, D = (argument.detach().to(dtype) for argument in arguments)
    grad_output = grad_output.to(dtype)
    head_dim = x.shape[-1]
    if name == "ssd":  # a selective scan whose channels and states share what a head has
        x, grad_output = x.flatten(2), grad_output.flatten(2)
        dt, D = dt.repeat_interleave(head_dim, -1), D.repeat_interleave(head_dim)
        A = A.repeat_interleave(head_dim)[:, None].expand(-1, B.shape[-1])
    x, dt, B, C, grad_output = (t.flip(1) if reverse else t for t in (x, dt, B, C, grad_output))
    arrays = (np.ascontiguousarray(t.numpy()) for t in (x, dt, A, B, C, D, grad_output))
    results = (torch.from_numpy(array) for array in _loop(*arrays))
    y, grad_x, grad_dt, grad_A, grad_B, grad_C, grad_D = results
    y, grad_x, grad_dt, grad_B, grad_C = (
        t.flip(1) if reverse else t for t in (y, grad_x, grad_dt, grad_B, grad_C)
    )
    if name == "ssd":
        y, grad_x = y.unflatten(-1, (-1, head_dim)), grad_x.unflatten(-1, (-1, head_dim))
        grad_dt, grad_D = (t.unflatten(-1, (-1, head_dim)).sum(-1) for t in (grad_dt, grad_D))
        grad_A = grad_A.unflatten(0, (-1, head_dim)).sum((1, 2))
    return y, (grad_x, grad_dt, grad_A, grad_B, grad_C, grad_D)


@numba.njit(cache=True)
def _loop(x, dt, A, B, C, D, grad_output):
    batch, length, channels = x.shape
    states = np.zeros((length + 1, A.shape[1]), x.dtype)  # that after t tokens at t
    grad_state = np.zeros(A.shape[1], x.dtype)
    y, grad_x, grad_dt = D * x, D * grad_output, np.zeros_like(x)
    grad_A, grad_B, grad_C = np.zeros_like(A), np.zeros_like(B), np.zeros_like(C)
    grad_D = np.zeros_like(D)
    for b in range(batch):
        for d in range(channels):
            for t in range(length):
                for n in range(A.shape[1]):
                    decay = np.exp(dt[b, t, d] * A[d, n])
                    new = dt[b, t, d] * x[b, t, d] * B[b, t, n]
                    states[t + 1, n] = decay * states[t, n] + new
                    y[b, t, d] += C[b, t, n] * states[t + 1, n]
            grad_state[:] = 0
            for t in range(length - 1, -1, -1):
                grad_D[d] += grad_output[b, t, d] * x[b, t, d]
                for n in range(A.shape[1]):
                    grad_C[b, t, n] += grad_output[b, t, d] * states[t + 1, n]
                    grad_state[n] += grad_output[b, t, d] * C[b, t, n]
                    grad_new = grad_state[n]
                    grad_x[b, t, d] += grad_new * dt[b, t, d] * B[b, t, n]
                    grad_B[b, t, n] += grad_new * dt[b, t, d] * x[b, t, d]
                    grad_state[n] *= np.exp(dt[b, t, d] * A[d, n])
                    grad_exponent = grad_state[n] * states[t, n]
                    grad_A[d, n] += grad_exponent * dt[b, t, d]
                    grad_dt[b, t, d] += grad_exponent * A[d, n]
                    grad_dt[b, t, d] += grad_new * x[b, t, d] * B[b, t, n]
    return y, grad_x, grad_dt, grad_A, grad_B, grad_C, grad_D
