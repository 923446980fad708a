"""Return the peak floating-point operations per second of a GPU."""

import torch

TERA = 1e12
# By torch's name of the device: dense bf16, TF32 and fp32 in TFLOP/s, from NVIDIA's data sheets.
PEAKS = {
    "NVIDIA H200": (989.4, 494.7, 66.9),
    "NVIDIA H100 80GB HBM3": (989.4, 494.7, 66.9),
    "NVIDIA H100 PCIe": (756.0, 378.0, 51.2),
    "NVIDIA A100-SXM4-40GB": (312.0, 156.0, 19.5),
    "NVIDIA A100-SXM4-80GB": (312.0, 156.0, 19.5),
    "NVIDIA A100 80GB PCIe": (312.0, 156.0, 19.5),
    "NVIDIA L40S": (362.0, 183.0, 91.6),
    "NVIDIA RTX A6000": (154.8, 77.4, 38.7),
    "NVIDIA GeForce RTX 4090": (165.2, 82.6, 82.6),
    "NVIDIA GeForce RTX 3090": (71.0, 35.6, 35.6),
}


def peak_flops(device: torch.device, precision: str) -> float | None:
    """Return the peak of a device in FLOP/s; None if unknown, and for every CPU.

    Args:
        precision: Lightning's, such as bf16-mixed or 32-true.
    """
    if device.type != "cuda" or torch.cuda.get_device_name(device) not in PEAKS:
        return None
    half, tf32, single = PEAKS[torch.cuda.get_device_name(device)]
    if "16" in precision:
        return TERA * half
    return TERA * (single if torch.get_float32_matmul_precision() == "highest" else tf32)
