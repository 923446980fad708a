"""Lightning's strategy for weights that are sharded among all processes."""

from lightning.pytorch.strategies import ModelParallelStrategy


class ShardedStrategy(ModelParallelStrategy):
    """Shards weights and batches among all processes of all nodes (FSDP2, also on CPUs).

    `configure_model` of the module shards the weights. A checkpoint is one file with all of them,
    which a single process can read too.
    """

    def __init__(self):
        super().__init__(tensor_parallel_size=1, save_distributed_checkpoint=False)

    def setup_environment(self) -> None:
        # Lightning's "auto" would shard weights within a node only, by tensor parallelism.
        self._data_parallel_size = self.num_nodes * self.num_processes
        super().setup_environment()
