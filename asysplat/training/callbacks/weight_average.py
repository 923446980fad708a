"""Average the weights over the steps of a training (exponential moving average, EMA)."""

from typing import Any

from lightning import Callback, LightningModule, Trainer
from torch import Tensor
from torch.distributed.checkpoint.state_dict import StateDictOptions, set_model_state_dict
from torch.distributed.tensor import DTensor
from torch.optim.swa_utils import get_ema_multi_avg_fn

TRAINED = "current_model_state"  # of a checkpoint; the name is that of Lightning's WeightAveraging


class WeightAverage(Callback):
    """Averages the weights, and running means of norms, over the steps of the optimizer.

    After step n, average = d average + (1 - d) weights, with d = min(decay, (1 + n) / (10 + n)) as
    TensorFlow's `ExponentialMovingAverage`. Validations and the test measure the average, and the
    `state_dict` of a checkpoint is the average; `TRAINED` are the weights that training resumes
    with. Lightning's `EMAWeightAveraging` neither shards its copy nor saves both after the last
    step, and has no warm-up.
    """

    def __init__(self, decay: float):
        self.decay = decay
        self.average: dict[str, Tensor] = {}  # by name, sharded as the weights; empty: not begun
        self.trained: dict[str, Tensor] = {}  # weights of the checkpoint that a run resumes from

    def on_load_checkpoint(
        self, trainer: Trainer, module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        self.trained = checkpoint.get(TRAINED, {})

    def on_train_start(self, trainer: Trainer, module: LightningModule) -> None:
        # The module has the checkpoint's average here, on its device.
        self.average = {name: tensor.clone() for name, tensor in module.state_dict().items()}
        if self.trained:
            options = StateDictOptions(full_state_dict=True)
            set_model_state_dict(module, self.trained, options=options)
            self.trained = {}

    def on_train_batch_end(
        self, trainer: Trainer, module: LightningModule, _: object, __: object, index: int
    ) -> None:
        if (index + 1) % trainer.accumulate_grad_batches:
            return
        step = trainer.global_step
        update = get_ema_multi_avg_fn(min(self.decay, (1 + step) / (10 + step)))
        pairs = self._pairs(module)
        for weight, average in pairs:
            if not weight.is_floating_point():  # counters of norms
                average.copy_(weight)
        weights, averages = zip(*[p for p in pairs if p[0].is_floating_point()], strict=True)
        update(averages, weights, step)

    def on_save_checkpoint(
        self, trainer: Trainer, module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        if self.average:
            checkpoint[TRAINED] = checkpoint["state_dict"]
            checkpoint["state_dict"] = {name: _whole(t) for name, t in self.average.items()}

    def on_validation_start(self, trainer: Trainer, module: LightningModule) -> None:
        self._exchange(module)

    def on_validation_end(self, trainer: Trainer, module: LightningModule) -> None:
        self._exchange(module)

    def on_fit_end(self, trainer: Trainer, module: LightningModule) -> None:
        # Later than `on_train_end`, where the last checkpoint is written.
        self._exchange(module)
        self.average = {}

    def _exchange(self, module: LightningModule) -> None:
        """Exchange the values of the module's weights and of the average."""
        for weight, average in self._pairs(module):
            before = weight.clone()
            weight.copy_(average)
            average.copy_(before)

    def _pairs(self, module: LightningModule) -> list[tuple[Tensor, Tensor]]:
        """Return this process's part of each weight and of its average."""
        weights = module.state_dict()
        return [(_part(weights[name]), _part(average)) for name, average in self.average.items()]


def average_weights(decay: float | None) -> WeightAverage | None:
    """Return the callback of a decay; None, which train.py leaves out, without one."""
    return None if decay is None else WeightAverage(decay)


def _whole(tensor: Tensor) -> Tensor:
    """Gather a sharded tensor on the CPU; every process must call this."""
    return tensor.full_tensor().cpu() if isinstance(tensor, DTensor) else tensor


def _part(tensor: Tensor) -> Tensor:
    return tensor.to_local() if isinstance(tensor, DTensor) else tensor
