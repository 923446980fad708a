"""The whole network on small photographs, forward and backward."""

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from functools import partial

import torch
from torch import nn
from torch.func import functional_call

from asysplat.benchmark.model.workload import make_net
from asysplat.benchmark.stability.judge import (
    ALL_PRECISIONS,
    IN_A_ROW,
    Case,
    Comparison,
    Tensors,
    judge,
)
from asysplat.benchmark.stability.views import Hostile, hostile_views
from asysplat.benchmark.timing import Result
from asysplat.models.network import Network
from asysplat.models.prior import Prior
from asysplat.scene import Cameras, Gaussians, Views

AREA = "network"
WILD = 1e4  # by which the decoder's weights are too large, as after a training gone wrong
HALF = ("black photographs", "noise photographs", "poses kilometers apart")  # also in 16 bits
HALF += ("fisheye-like focal lengths", "telescopic focal lengths")
# Of the 3,600 operations that round, in both passes of the laptop's network; in half precision
# products alone do.
ALL_IN_A_ROW = 1024
NAMES = tuple(field.name for field in fields(Gaussians))


class Known(nn.Module):
    """The prior that was found before, in the float type of the views.

    Which plane costs least is a decision: that of another precision would be another input.
    """

    def __init__(self, prior: Prior):
        super().__init__()
        self.found = prior

    def forward(self, views: Views, size: tuple[int, int]) -> Prior:
        return self.found.to(views.images)


def cases(
    models: Sequence[str], overrides: Mapping[str, object], counts: Sequence[int]
) -> Iterator[Case]:
    """Yield the cases of each model.

    Args:
        models: files of conf/model.
        overrides: of train.py.
        counts: numbers of views.
    """
    for model in models:
        net, _ = make_net(model, overrides, torch.device("cpu"))
        for name, hostile in hostile_views(Hostile(), counts).items():
            yield Case(AREA, f"{model}, {name}", "fp32", partial(_measure, net, hostile))
        measure = partial(_measure, net, Hostile(), wild=True)
        yield Case(AREA, f"{model}, wild weights", "fp32", measure)
        for precision in ("bf16", "fp16"):
            for name in HALF:
                measure = partial(_measure, net, hostile_views(Hostile())[name], precision)
                yield Case(AREA, f"{model}, {name}", precision, measure)


def _measure(net: Network, hostile: Hostile, precision: str = "fp32", wild: bool = False) -> Result:
    """Compare with the same network in float64; in fp16 without gradients, which underflow."""
    views, net = hostile.views(), copy.deepcopy(net).eval()
    if net.prior is not None:
        size = (hostile.side // net.head.stride,) * 2
        net.prior = Known(net.prior(views.map(lambda tensor: tensor[None]), size))
    if wild:
        net.head.decode.weight.data *= WILD
    weights = {name: parameter.detach() for name, parameter in net.named_parameters()}
    cameras = views.cameras
    inputs = {
        "images": views.images,
        "cam_to_world": cameras.cam_to_world,
        "intrinsics": cameras.intrinsics,
        **weights,
    }
    dtype = ALL_PRECISIONS[precision]
    half = dtype != torch.float32

    def predict(net: Network, autocast: bool, tensors: Tensors) -> Tensors:
        moved = Cameras(tensors["intrinsics"], tensors["cam_to_world"], *views.images.shape[-2:])
        state = {name: tensors[name] for name in weights}
        seen = Views(moved, tensors["images"])
        with torch.autocast("cpu", dtype, enabled=autocast):
            gaussians = functional_call(net, state, (seen,))
        return {name: getattr(gaussians, name) for name in NAMES}

    double = copy.deepcopy(net).double()
    return judge(
        Comparison(
            fast=partial(predict, net, half),
            exact=partial(predict, double, False),
            network=double,
            inputs=inputs,
            leaves=() if precision == "fp16" else ("images", *weights),
            arithmetic=dtype,
            in_a_row=IN_A_ROW if half else ALL_IN_A_ROW,
        )
    )
