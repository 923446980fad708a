"""The memory of a training step, counted from sizes and from rates measured on a CPU."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

from asysplat.data.batches import largest_divisor
from asysplat.evaluation.cost import GB
from asysplat.evaluation.static_cost import Activations

WEIGHT_BYTES = 16  # of a parameter: itself, its gradient and AdamW's two moments, in fp32
FIELDS, FIELDS_DEFERRED = 2, 5  # copies of the Gaussians' fields that rendering holds at most
SPLAT_BYTES = 132  # of a Gaussian in a view that is rendered
PERCEPTUAL_BYTES, IMAGE_BYTES = 3000, 1100  # of a target pixel: VGG's activations; SSIM's


@dataclass(frozen=True)
class Held:
    """The settings that bound what a process holds at a time.

    Args:
        micro_batch: scenes.
        checkpoint_layers, views_at_once: see `SplattingModule`.
    """

    micro_batch: int
    checkpoint_layers: bool
    views_at_once: int | None

    def smaller(self, share: int) -> Iterator["Held"]:
        """Yield settings that need ever less memory, those that cost least time first.

        Args:
            share: of a process in a global batch, in scenes.
        """
        held = replace(self, checkpoint_layers=True)
        yield held
        held = replace(held, views_at_once=1)
        yield held
        while held.micro_batch > 1:
            held = replace(held, micro_batch=largest_divisor(share, held.micro_batch - 1))
            yield held

    def overrides(self, of: "Held") -> str:
        """Write the options in which it differs from other settings."""
        named = {
            "data.micro_batch": (self.micro_batch, of.micro_batch),
            "training.checkpoint_layers": (self.checkpoint_layers, of.checkpoint_layers),
            "training.views_at_once": (self.views_at_once, of.views_at_once),
        }
        return " ".join(f"{k}={str(new).lower()}" for k, (new, old) in named.items() if new != old)


@dataclass(frozen=True)
class Sizes:
    """What the memory of a process follows from.

    Args:
        parameters: of the network, those that this process holds.
        activations: of a scene.
        gaussians, fields_gb: of a scene: how many, and the size of all their fields.
        targets, pixels: of a scene: views to render, and pixels of one.
        pixel_bytes: that the loss holds.
        side_by_side: scenes that a CPU computes at a time; None: all of a micro-batch.
    """

    parameters: int
    activations: Activations
    gaussians: int
    fields_gb: float
    targets: int
    pixels: int
    pixel_bytes: int
    side_by_side: int | None

    def parts(self, held: Held) -> dict[str, float]:
        """Count the memory by what it is for, in 1e9 bytes."""
        scenes = min(held.micro_batch, self.side_by_side or held.micro_batch)
        weights = WEIGHT_BYTES * self.parameters
        if self.side_by_side and held.micro_batch > 1:  # the gradients of each scene
            weights += 4 * self.parameters * held.micro_batch
        kept = self.activations.checkpointed if held.checkpoint_layers else self.activations.kept
        views = min(held.views_at_once or self.targets, self.targets)
        copies = FIELDS if views == self.targets else FIELDS_DEFERRED
        splats = SPLAT_BYTES * self.gaussians * views
        return {
            "weights": weights / GB,
            "activations": scenes * kept,
            "rendering": scenes * (copies * self.fields_gb + splats / GB),
            "loss": scenes * self.pixel_bytes * self.targets * self.pixels / GB,
        }

    def gb(self, held: Held) -> float:
        return sum(self.parts(held).values())

    def that_fits(self, held: Held, share: int, capacity: float) -> str:
        """Write the settings that need at most `capacity` GB, as overrides; or what else to do."""
        found = next((h for h in held.smaller(share) if self.gb(h) <= capacity), None)
        if found is None:
            return "take fewer data.inputs, smaller data.height and data.width, or a larger device"
        return f"set {found.overrides(held)} (about {self.gb(found):.3g} GB)"
