"""Weights that Long-LRM's public code trained, as model=longlrm takes them.

asysplat import checkpoint_000060000.pt longlrm.safetensors
"""

from argparse import ArgumentParser
from pathlib import Path

from asysplat.cli import exit_with_message
from asysplat.files import check_exists

if __name__ == "__main__":  # now, since torch takes seconds
    parser = ArgumentParser("asysplat import", description=__doc__.split("\n")[0])
    parser.add_argument("checkpoint", type=Path, help="a .pt file of Long-LRM's public code")
    parser.add_argument("output", type=Path, help="the new .safetensors file")
    parser.add_argument(
        "overrides",
        nargs="*",
        metavar="option=value",
        help="options of train.py, after model=longlrm scale=paper, for a model of other sizes",
    )
    arguments = parser.parse_args()
    with exit_with_message("stopped."):
        check_exists(arguments.checkpoint, "a .pt file of Long-LRM's public code")

from collections.abc import Mapping, Sequence

import torch
from safetensors.torch import save_file
from torch import Tensor

from asysplat import load
from asysplat.errors import InputError
from asysplat.files import atomic_write
from asysplat.interrupts import handle_signals
from asysplat.models import BiMamba2, LongLRMHead, SingleBranch

# Networks of the loss, which the checkpoint holds too.
LOSS = ("perceptual_loss.", "depth_anything.")
# Our names of modules and parameters: those of https://github.com/arthurhero/Long-LRM, model/.
NAMES = {
    "global_tokens": "global_token_init",
    "tokenizer.embed": "tokenizer",
    "tokenizer.norm": "input_layernorm",
    "head.norm": "tokenDecoder.0",
    "head.decode": "tokenDecoder.1",
}
MAMBA2_NAMES = {
    "norm": "norm",
    "project": "mamba.in_proj",
    "directions.0.conv": "mamba.mamba_scans.0.conv1d",
    "directions.1.conv": "mamba.mamba_scans.1.conv1d",
    "directions": "mamba.mamba_scans",
    "out": "mamba.out_proj",
}
ATTENTION_NAMES = {
    "norm": "norm1",
    "qkv": "attn.qkv",
    "out": "attn.proj",
    "mlp_norm": "norm2",
    "mlp.0": "mlp.fc1",
    "mlp.2": "mlp.fc2",
}


def import_weights(checkpoint: Path, output: Path, overrides: Sequence[str] = ()) -> None:
    """Write the weights of Long-LRM's checkpoint as a file for `init_path`, and print its size.

    Args:
        checkpoint: what Long-LRM's main.py writes.
        output: the new .safetensors file.
        overrides: options of train.py, after model=longlrm scale=paper.

    Raises:
        InputError: files that cannot be read or written, or the weights of another model.
    """
    if output.suffix != ".safetensors" or output.exists():
        raise InputError(f"{output} exists or is not named .safetensors: name a new file.")
    with torch.device("meta"):
        net = load(None, ["model=longlrm", "scale=paper", *overrides])
    if not (isinstance(net, SingleBranch) and isinstance(net.head, LongLRMHead)):
        raise InputError(
            f"{' '.join(overrides)} give a model other than Long-LRM: change only the sizes of "
            "model=longlrm."
        )
    try:
        content = torch.load(checkpoint, map_location="cpu", mmap=True, weights_only=True)
        weights = content["model"]
    except Exception as error:  # torch raises many kinds
        raise InputError(
            f"{checkpoint} cannot be read as a checkpoint of Long-LRM, weights alone in its entry "
            "model: name a .pt file that its main.py wrote."
        ) from error
    converted = convert_weights(weights, net, str(checkpoint))
    with atomic_write(output) as partial:
        save_file({f"net.{name}": tensor for name, tensor in converted.items()}, partial)
    print(f"{output}: {net.describe()}, {output.stat().st_size / 1e6:.2f} MB")


def convert_weights(
    weights: Mapping[str, Tensor], net: SingleBranch, source: str
) -> dict[str, Tensor]:
    """Return Long-LRM's weights with the names and layouts of ours.

    The order of inputs, patches, queries, keys and values, and of Mamba2's projection (z, x, B, C,
    dt) is the same; that of a Gaussian's numbers differs, and the global tokens have one dimension
    more.

    Raises:
        InputError: a weight is missing, unknown or of another shape; `source` is the file's name.
    """
    names = long_lrm_names(net)
    given = {name for name in weights if not name.startswith(LOSS)}
    advice = "give the options of the model that was trained, as in conf/model/longlrm.yaml."
    for name in (*names, *sorted(given)):
        if name not in given or name not in names:
            found = "has no" if name in names else "also has"
            raise InputError(f"{source} {found} {name}: {advice}")
    expected, converted = net.state_dict(), {}
    for name, ours in names.items():
        tensor = weights[name].squeeze(0) if ours == "global_tokens" else weights[name]
        if tensor.shape != expected[ours].shape:
            raise InputError(
                f"{source}: {name} is {tuple(weights[name].shape)}, but this model's "
                f"{ours} is {tuple(expected[ours].shape)}: {advice}"
            )
        converted[ours] = tensor.float().contiguous()
    decode = converted["head.decode.weight"]
    position, quats, scales, opacity, sh = net.head.splits
    numbers = decode.unflatten(0, (-1, sum(net.head.splits)))
    position, sh, scales, quats, opacity = numbers.split((position, sh, scales, quats, opacity), 1)
    numbers = torch.cat((position, quats, scales, opacity, sh), 1)
    converted["head.decode.weight"] = numbers.flatten(0, 1)
    return converted


def long_lrm_names(net: SingleBranch) -> dict[str, str]:
    """Return our name of every weight by its name in Long-LRM's public code."""
    modules, layer, merges = dict(NAMES), 0, 0
    for number, stage in enumerate(net.stages):
        if stage.merge is not None:
            modules[f"stages.{number}.merge.conv"] = f"processor.merge_blocks.{merges}"
            modules[f"stages.{number}.project"] = f"processor.resize_blocks.{merges}"
            merges += 1
        for place, block in enumerate(stage.layers):
            table = MAMBA2_NAMES if isinstance(block, BiMamba2) else ATTENTION_NAMES
            for ours, theirs in table.items():
                prefix = f"stages.{number}.layers.{place}"
                modules[f"{prefix}.{ours}"] = f"processor.blocks.{layer}.{theirs}"
            layer += 1
    return {_rename(name, modules): name for name in net.state_dict()}


def _rename(name: str, modules: Mapping[str, str]) -> str:
    for ours, theirs in modules.items():
        if name == ours or name.startswith(f"{ours}."):
            return theirs + name.removeprefix(ours)
    return name


if __name__ == "__main__":
    handle_signals()
    with exit_with_message("stopped."):
        import_weights(arguments.checkpoint, arguments.output, arguments.overrides)
