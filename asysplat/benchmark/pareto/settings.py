"""The knobs: settings of a network's prediction and of a refinement, and how each draws a scene."""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import Any

import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torch import Tensor

from asysplat.benchmark.options import PRECISIONS, check_names
from asysplat.benchmark.pareto.scenes import PosedScene
from asysplat.data.normalize import Normalization
from asysplat.errors import InputError, input_error_behind
from asysplat.models.network import Network
from asysplat.refinement import RefinementSettings, mean_color, refine, thinned
from asysplat.refinement.init import INITS, initial_gaussians
from asysplat.refinement.photographs import Photographs
from asysplat.rendering import INRIA, render
from asysplat.scene import Cameras, Gaussians
from asysplat.training.load import load

EXACT = "fp64"
CPU = torch.device("cpu")

Draw = Callable[[PosedScene], Tensor]  # all targets [V, 3, H, W], of a scene on the device


@dataclass(frozen=True)
class FeedForward:
    """A network's prediction, what is left of it, and its pictures.

    Args:
        views: photographs that the network sees.
        side: of these, pixels.
        checkpoint: see `load`; None: untrained, whose pictures are compared with its own in
            float64.
        overrides: of train.py; with a checkpoint they may change no weights.
        precision: of the network: fp32, bf16 by autocast, or fp64, in which all is computed.
        least_opacity: below which Gaussians are dropped.
        cell: side of the cells whose Gaussians are merged, in pixels; None: none are.
        most: Gaussians, until which cells grow; None: any number.
        sh_degree: up to which colors are drawn; None: all.
        views_at_once: that are drawn; None: all.
        convention: cut-offs of the renderer that differ, see `Convention`.
    """

    views: int
    side: int
    checkpoint: str | None = "shipped"
    overrides: Sequence[str] = ()
    precision: str = "fp32"
    least_opacity: float = 0.0
    cell: float | None = None
    most: int | None = None
    sh_degree: int | None = None
    views_at_once: int | None = None
    convention: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self):
        check_names("precision", [self.precision], [*PRECISIONS, EXACT])
        given = [name for name in ("most", "views_at_once") if getattr(self, name) is not None]
        check_whole(self, "views", "side", *given)
        if self.convention:
            check_names("convention", self.convention, [each.name for each in fields(INRIA)])

    @property
    def trained(self) -> bool:
        return self.checkpoint is not None

    def exact(self, base: "FeedForward") -> "FeedForward":
        """Return what this one's pictures are compared with."""
        return replace(base if self.trained else self, precision=EXACT)

    def prepare(self, refinement: DictConfig, device: torch.device) -> Draw:
        """Load the network; return what draws.

        Raises:
            InputError: no such file or override, or weights that do not fit.
        """
        net = _network(self.checkpoint, tuple(self.overrides))
        dtype = torch.float64 if self.precision == EXACT else torch.float32
        if (device, dtype) != (CPU, torch.float32):
            net = deepcopy(net).to(device, dtype)
        return lambda scene: self._draw(scene, net, dtype)

    @torch.no_grad()
    def _draw(self, scene: PosedScene, net: Network, dtype: torch.dtype) -> Tensor:
        inputs, targets = (views.to(dtype) for views in scene.given(self.views, self.side))
        half = PRECISIONS.get(self.precision) == torch.bfloat16
        with torch.autocast(inputs.images.device.type, torch.bfloat16, enabled=half):
            gaussians = net(inputs)
        gaussians = self._kept(gaussians.to(dtype), inputs.cameras)
        out = render(
            gaussians,
            targets.cameras,
            mean_color(inputs),
            depth=False,
            sh_degree=self.sh_degree,
            convention=replace(INRIA, **self.convention),
            views_at_once=self.views_at_once,
        )
        return out.image

    def _kept(self, gaussians: Gaussians, cameras: Cameras) -> Gaussians:
        if self.least_opacity > 0:
            gaussians = gaussians.keep(gaussians.opacities >= self.least_opacity)
        if self.cell is None and self.most is None:
            return gaussians
        return thinned(gaussians, cameras, self.cell or 1.0, self.most or gaussians.num_gaussians)


@dataclass(frozen=True)
class Refined:
    """A start and a refinement of so many steps, and its pictures.

    Args:
        views: photographs that are fitted to.
        side: of these, pixels.
        steps: of the refinement: in place of seconds, so that every round gives the same bits.
        init: see `initial_gaussians`; the network is the shipped one.
        refinement: what differs from `refinement`, a file of conf/refinement.
    """

    views: int
    side: int
    steps: int
    init: str = "sweep"
    refinement: Mapping[str, Any] = field(default_factory=dict)

    trained = True

    def __post_init__(self):
        check_names("init", [self.init], INITS)
        check_whole(self, "views", "side", "steps")

    def exact(self, base: "Refined") -> "Refined":
        """Return what this one's pictures are compared with."""
        return base

    def prepare(self, refinement: DictConfig, device: torch.device) -> Draw:
        """Read the settings; return what draws, on the CPU.

        Raises:
            InputError: an unknown setting or one out of range.
        """
        try:
            settings = instantiate(OmegaConf.merge(refinement, dict(self.refinement)))
        except (OmegaConfBaseException, InstantiationException, ValueError) as error:
            said = f"{self.refinement} are no settings of a refinement."
            raise InputError(str(input_error_behind(error) or said)) from None
        net = _network("shipped", ()) if self.init == "network" else None
        return lambda scene: self._draw(scene, settings, net)

    def _draw(self, scene: PosedScene, settings: RefinementSettings, net: Network | None) -> Tensor:
        inputs, targets = scene.given(self.views, self.side)
        frame = Normalization(torch.eye(4, dtype=torch.float64), 1.0)
        photographs = Photographs(scene.name, inputs, targets, [], [], frame, None)
        start = initial_gaussians(self.init, photographs, settings.most, net)
        background = mean_color(inputs)
        gaussians = refine(start, inputs, settings, steps=self.steps, background=background)
        with torch.no_grad():
            return render(gaussians, targets.cameras, background, depth=False).image


BASE = "base"  # the setting that each knob changes
FAMILIES = {"feed_forward": FeedForward, "networks": FeedForward, "refined": Refined}
Setting = FeedForward | Refined


def find_settings(family: str, base: Mapping, knobs: Mapping[str, Mapping]) -> dict[str, Setting]:
    """Return the setting BASE of a family, and that of each knob.

    Args:
        family: of FAMILIES.
        base: all settings.
        knobs: by name, what is different from it.

    Raises:
        InputError: a knob that is none.
    """
    found = {}
    for name, changes in ({BASE: {}} | dict(knobs)).items():
        where = f"pareto.{family}.{name}"
        if not isinstance(changes, Mapping):
            raise InputError(f"{where}={changes} is no setting: give {{name: value}}.")
        known = [each.name for each in fields(FAMILIES[family])]
        check_names(where, {**base, **changes}, known)
        try:
            found[name] = FAMILIES[family](**(dict(base) | dict(changes)))
        except (InputError, TypeError) as error:
            raise InputError(f"{where}: {error}") from error
    return found


def check_whole(setting: Setting, *names: str) -> None:
    """Raise InputError unless these are whole numbers from 1."""
    for name in names:
        value = getattr(setting, name)
        if type(value) is not int or value < 1:
            raise InputError(f"{name}={value}: give a whole number from 1.")


@cache
def _network(checkpoint: str | None, overrides: tuple[str, ...]) -> Network:
    torch.manual_seed(0)
    return load(checkpoint, overrides)
