"""Lightning's strategy for weights that are divided among all processes."""

from lightning.pytorch.strategies import ModelParallelStrategy


class ShardedStrategy(ModelParallelStrategy):
    """Divides weights and batches among all processes of all nodes (FSDP2, also on CPUs).

    `configure_model` of the module divides the weights. A checkpoint is one file with all of them,
    which one process reads as well.
    """

    def __init__(self):
        super().__init__(tensor_parallel_size=1, save_distributed_checkpoint=False)

    def setup_environment(self) -> None:
        # Lightning's "auto" would divide weights within a node alone, by tensor parallelism.
        self._data_parallel_size = self.num_nodes * self.num_processes
        super().setup_environment()
