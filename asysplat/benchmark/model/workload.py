"""A network of conf/model and an input for it: the passes that are measured."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property

import hydra
import torch
from hydra.utils import instantiate

from asysplat.benchmark.options import PRECISIONS
from asysplat.benchmark.scenes import on_an_arc, random_scene
from asysplat.evaluation.cost import GB, count_parameters, memory_gb
from asysplat.evaluation.static_cost import activation_gb
from asysplat.models.network import Network
from asysplat.overrides import check_overrides
from asysplat.scene import Gaussians, Views

FILLED = 0.75  # of the memory, at most: a step also needs what it does not keep


@dataclass(frozen=True)
class Workload:
    """What is measured: a network, its input and their precision."""

    name: str  # of the model
    net: Network  # with random weights
    precision: str  # of PRECISIONS; bf16 by autocast
    views: Views  # of one scene

    @property
    def device(self) -> torch.device:
        return self.views.images.device

    @property
    def tokens(self) -> int:
        """Count the tokens of the network's largest patch, those that most layers work on."""
        cameras = self.views.cameras
        return cameras.num_views * cameras.height * cameras.width // self.net.patch**2

    def forward(self) -> Gaussians:
        """Reconstruct the scene."""
        self.net.eval()
        with torch.no_grad(), self._autocast(self.device.type):
            return self.net(self.views)

    def step(self) -> None:
        """Run a training step without renderer and optimizer: the loss is a mean of the outputs."""
        self.net.train()
        with self._autocast(self.device.type):
            gaussians = self.net(self.views)
            means = [getattr(gaussians, field.name).float().mean() for field in fields(gaussians)]
        sum(means).backward()
        self.net.zero_grad(set_to_none=True)

    @cached_property
    def step_gb(self) -> float:
        """Estimate the memory of a step: activations, parameters and their gradients."""
        cameras = self.views.cameras
        self.net.train()
        with self._autocast("cpu"):
            kept = activation_gb(self.net, cameras.num_views, cameras.height, cameras.width)
        return kept + 2 * 4 * count_parameters(self.net) / GB

    @property
    def step_fits(self) -> bool:
        return self.step_gb < FILLED * memory_gb(self.device)

    def _autocast(self, device: str) -> torch.autocast:
        dtype = PRECISIONS[self.precision]
        return torch.autocast(device, dtype, enabled=dtype != torch.float32)


def make_net(
    name: str, overrides: Mapping[str, object], device: torch.device
) -> tuple[Network, dict[str, int]]:
    """Build the network that train.py would; return also its number of inputs, height and width.

    Raises:
        InputError: an unknown model, or an unknown choice among the overrides.
    """
    command = [f"model={name}", *(f"{key}={value}" for key, value in overrides.items())]
    check_overrides(command)
    config = hydra.compose("train", command)
    torch.manual_seed(0)
    with device:
        net = instantiate(config.model)
    return net, {name: config.data[name] for name in ("inputs", "height", "width")}


def make_views(views: int, height: int, width: int, device: torch.device) -> Views:
    """Make views of noise, from cameras on an arc."""
    _, camera = random_scene(1, height, width)
    images = torch.rand(views, 3, height, width, generator=torch.Generator().manual_seed(0))
    return Views(on_an_arc(camera, views), images).to(device)
