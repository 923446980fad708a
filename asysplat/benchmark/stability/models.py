"""The plane sweep, the prior and the whole network on hostile views."""

import copy
from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import torch
from torch import nn
from torch.func import functional_call

from asysplat.benchmark.model import make_net
from asysplat.benchmark.stability.comparison import (
    ALL_PRECISIONS,
    ROUNDINGS,
    Function,
    StabilityCase,
    Tensors,
    compare_to_reference,
)
from asysplat.benchmark.stability.hostile import FIELDS, HostileViews, hostile_views
from asysplat.benchmark.timing import Result
from asysplat.models.network import Network
from asysplat.models.prior import PlaneSweepPrior, Prior
from asysplat.models.prior.plane_sweep import plane_sweep
from asysplat.scene import Cameras, Views

MIN_INVERSE_DEPTH = 1e-30  # avoids division by 0 where the plane sweep finds nothing
WILD = 1e4  # factor of the decoder's weights, as after a failed training
# Views for 16 bits.
HALF = ("black photographs", "noise photographs", "poses kilometers apart")
HALF += ("fisheye-like focal lengths", "telescopic focal lengths")
# Of the 3,600 operations that round in both passes of the laptop's network; in half precision only
# products round.
NETWORK_ROUNDINGS = 1024


def plane_sweep_cases() -> Iterator[StabilityCase]:
    """Yield the cases of the plane sweep, an operator."""
    for name, hostile in hostile_views().items():
        run = partial(_measure_depth, _plane_sweep, hostile)
        yield StabilityCase("operators", f"plane_sweep, {name}", "fp32", run)


def prior_cases(counts: Sequence[int]) -> Iterator[StabilityCase]:
    """Yield the cases of the prior, also for these numbers of views."""
    for name, hostile in hostile_views(counts).items():
        yield StabilityCase("prior", name, "fp32", partial(_measure_depth, _prior, hostile))


def _measure_depth(function: Function, hostile: HostileViews) -> Result:
    views = hostile.views()
    inputs = {
        "images": views.images[None],
        "intrinsics": views.cameras.intrinsics[None],
        "cam_to_world": views.cameras.cam_to_world[None],
    }
    return compare_to_reference(function, function, inputs, magnitude=1.0)


def _cameras(tensors: Tensors) -> Cameras:
    return Cameras(tensors["intrinsics"], tensors["cam_to_world"], *tensors["images"].shape[-2:])


def _plane_sweep(tensors: Tensors) -> Tensors:
    """Compute confidence, and inverse depth over its maximum, weighted by confidence."""
    depth = plane_sweep(tensors["images"], _cameras(tensors))
    inverse = depth.inverse_depth / depth.inverse_depth.max().clamp_min(MIN_INVERSE_DEPTH)
    weighted = depth.confidence * inverse
    return {"confidence": depth.confidence, "confidence x inverse depth": weighted}


def _prior(tensors: Tensors) -> Tensors:
    images = tensors["images"]
    prior = PlaneSweepPrior()(Views(_cameras(tensors), images), tuple(images.shape[-2:]))
    return {
        "confidence": prior.confidence,
        "confidence x log distance": prior.confidence * prior.distance.log(),
        "opacity": prior.opacity,
    }


class FixedPrior(nn.Module):
    """A prior computed before, in the float type of the views.

    The plane of the lowest cost is a discrete choice: another precision's would be another input.
    """

    def __init__(self, prior: Prior):
        super().__init__()
        self.prior = prior

    def forward(self, views: Views, size: tuple[int, int]) -> Prior:
        return self.prior.to(views.images)


def network_cases(
    models: Sequence[str], overrides: Mapping[str, object], counts: Sequence[int]
) -> Iterator[StabilityCase]:
    """Yield the cases of each model.

    Args:
        models: files of conf/model.
        overrides: of train.py.
        counts: numbers of views.
    """
    for model in models:
        net, _ = make_net(model, overrides, torch.device("cpu"))

        def case(name: str, hostile: HostileViews, precision: str, model=model, net=net, **options):
            run = partial(_measure_network, net, hostile, precision, **options)
            return StabilityCase("network", f"{model}, {name}", precision, run)

        for name, hostile in hostile_views(counts).items():
            yield case(name, hostile, "fp32")
        yield case("wild weights", HostileViews(), "fp32", wild=True)
        for precision in ("bf16", "fp16"):
            for name in HALF:
                yield case(name, hostile_views()[name], precision)


def _measure_network(
    net: Network, hostile: HostileViews, precision: str, wild: bool = False
) -> Result:
    """Compare with the same network in float64; in fp16 without gradients, which underflow."""
    views, net = hostile.views(), copy.deepcopy(net).eval()
    if net.prior is not None:
        size = (hostile.side // net.head.stride,) * 2
        net.prior = FixedPrior(net.prior(views.map(lambda tensor: tensor[None]), size))
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
        state = {name: tensors[name] for name in weights}
        with torch.autocast("cpu", dtype, enabled=autocast):
            gaussians = functional_call(net, state, (Views(_cameras(tensors), tensors["images"]),))
        return {name: getattr(gaussians, name) for name in FIELDS}

    double = copy.deepcopy(net).double()
    return compare_to_reference(
        partial(predict, net, half),
        partial(predict, double, False),
        inputs,
        () if precision == "fp16" else ("images", *weights),
        network=double,
        arithmetic=dtype,
        roundings=ROUNDINGS if half else NETWORK_ROUNDINGS,
    )
