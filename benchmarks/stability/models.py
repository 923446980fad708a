"""The plane sweep, its Gaussians and the whole network on hostile views."""

import copy
from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import torch
from torch.func import functional_call

from asysplat.models.network import Network
from asysplat.models.prior import PlaneSweep
from asysplat.models.prior.plane_sweep import plane_sweep
from asysplat.scene import Cameras, Views
from benchmarks.model import make_net
from benchmarks.stability.comparison import (
    ALL_PRECISIONS,
    ROUNDINGS,
    StabilityCase,
    Tensors,
    compare_to_reference,
)
from benchmarks.stability.hostile import FIELDS, HostileViews, hostile_views
from benchmarks.timing import Result

MIN_INVERSE_DEPTH = 1e-30  # avoids division by 0 where the plane sweep finds nothing
# Weights of the decoder are multiplied by this factor, as after a failed training
WILD, WILD_FACTOR = "wild weights", 1e4
# Hostile views that are measured in half precision too
HALF_PRECISION_VIEWS = ("black photographs", "noise photographs", "poses kilometers apart")
HALF_PRECISION_VIEWS += ("fisheye-like focal lengths", "telescopic focal lengths")
# Roundings in sequence: fewer than the 3,600 operations that round in both passes of the network at
# laptop scale. In half precision only products round, so that ROUNDINGS suffice.
NETWORK_ROUNDINGS = 1024


def depth_cases(plane_sweep: bool, counts: Sequence[int] = ()) -> list[StabilityCase]:
    """List the cases of the plane sweep or of its Gaussians; `counts` are numbers of views."""
    prefix, function = ("plane_sweep, ", _plane_sweep) if plane_sweep else ("", _prior)

    def measure(hostile: HostileViews) -> Result:
        tensors = _tensors(hostile.views())
        # The order decides which random numbers perturb each tensor
        inputs = {name: tensors[name][None] for name in ("images", "intrinsics", "cam_to_world")}
        return compare_to_reference(function, function, inputs, magnitude=1.0)

    return [
        StabilityCase(prefix + name, "fp32", partial(measure, hostile))
        for name, hostile in hostile_views(counts).items()
    ]


def _tensors(views: Views) -> Tensors:
    poses, intrinsics = views.cameras.cam_to_world, views.cameras.intrinsics
    return {"images": views.images, "cam_to_world": poses, "intrinsics": intrinsics}


def _cameras(tensors: Tensors) -> Cameras:
    return Cameras(tensors["intrinsics"], tensors["cam_to_world"], *tensors["images"].shape[-2:])


def _plane_sweep(tensors: Tensors) -> Tensors:
    depth = plane_sweep(tensors["images"], _cameras(tensors))
    inverse = depth.inverse_depth / depth.inverse_depth.max().clamp_min(MIN_INVERSE_DEPTH)
    weighted = depth.confidence * inverse
    return {"confidence": depth.confidence, "confidence x inverse depth": weighted}


def _prior(tensors: Tensors) -> Tensors:
    views = Views(_cameras(tensors), tensors["images"])
    gaussians = PlaneSweep()(views)
    confidence = PlaneSweep().sweep(views).confidence.flatten(1)
    return {
        "confidence x log size": confidence * gaussians.scales[..., 0].log(),
        "opacity": gaussians.opacities,
        "color": gaussians.sh,
    }


def network_cases(
    models: Sequence[str], overrides: Mapping[str, object], counts: Sequence[int]
) -> Iterator[StabilityCase]:
    """Yield the cases of each network.

    Args:
        models: files of conf/model.
        overrides: overrides of train.py.
        counts: numbers of views.
    """
    for model in models:
        net, _ = make_net(model, overrides, torch.device("cpu"))
        views = hostile_views(counts)
        cases = [(name, views[name], "fp32") for name in views]
        cases.append((WILD, HostileViews(), "fp32"))
        cases += [
            (name, views[name], precision)
            for precision in ("bf16", "fp16")
            for name in HALF_PRECISION_VIEWS
        ]
        for name, hostile, precision in cases:
            run = partial(_measure_network, net, hostile, precision, wild=name == WILD)
            yield StabilityCase(f"{model}, {name}", precision, run)


def _measure_network(net: Network, hostile: HostileViews, precision: str, wild: bool) -> Result:
    """Compare a network with itself in float64; without gradients in fp16, where they underflow."""
    views, net = hostile.views(), copy.deepcopy(net).eval()
    if wild:
        net.head.decode.weight.data *= WILD_FACTOR
    weights = {name: parameter.detach() for name, parameter in net.named_parameters()}
    dtype = ALL_PRECISIONS[precision]
    half = dtype != torch.float32

    def predict(net: Network, autocast: bool, tensors: Tensors) -> Tensors:
        state = {name: tensors[name] for name in weights}
        with torch.autocast("cpu", dtype, enabled=autocast):
            gaussians = functional_call(net, state, (Views(_cameras(tensors), tensors["images"]),))
        return {name: getattr(gaussians, name) for name in FIELDS}

    double = copy.deepcopy(net).double()
    # Set without the layers' flags: in training, the network does not validate its views, in which
    # a perturbed white exceeds 1.
    double.training = True
    return compare_to_reference(
        partial(predict, net, half),
        partial(predict, double, False),
        _tensors(views) | weights,
        () if precision == "fp16" else ("images", *weights),
        network=double,
        arithmetic=dtype,
        roundings=ROUNDINGS if half else NETWORK_ROUNDINGS,
    )
