"""Options for a run of the tiniest size, and the smallest module to train."""

import lightning
import torch

SIZE = ["width=0.125", "state_size=8"]
NETWORK = [*SIZE, "model.layers=1m1s"]
VIEWS = [
    *("data.height=32", "data.width=32", "data.inputs=3", "data.targets=2", "data.num_workers=0"),
]
SCENES = ["data.num_images=24", "data.window=[12,24]", "data.val_scenes=1", "data.test_scenes=1"]
STEPS = ["steps=4", "validate_every=2", "trainer.log_every_n_steps=1"]
# A Lightning trainer that only trains or tests.
QUIET = {
    "accelerator": "cpu",
    "logger": False,
    "enable_progress_bar": False,
    "enable_model_summary": False,
}


class OneLayer(lightning.LightningModule):
    """A linear layer trained by SGD."""

    def __init__(self, inputs=1):
        super().__init__()
        self.layer = torch.nn.Linear(inputs, 1, bias=False)

    def training_step(self, batch, index):
        return self.layer(torch.ones(1)).sum()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)
