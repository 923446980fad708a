"""Two processes that train together take the steps of one process on both their scenes."""

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from hydra.utils import instantiate
from test_module import MODELS
from test_side_by_side import make_batch
from torch import nn
from torch.nn.parallel import DistributedDataParallel

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

OVERRIDES = ["width=0.125", "state_size=8", "training.loss.depth=0", "training.loss.perceptual=0"]
PROCESSES = 2


class Loss(nn.Module):
    """A batch's loss, as the forward pass that DistributedDataParallel waits for."""

    def __init__(self, module):
        super().__init__()
        self.module = module

    def forward(self, batch):
        prediction = self.module(batch, depth=self.module.loss.needs_depth)
        return self.module.loss(prediction, batch)["loss"]


def make_loss(config):
    """The same weights in every process."""
    torch.manual_seed(0)
    return Loss(instantiate(config.training, net=instantiate(config.model)))


def fixed_batch_norms(loss):
    """Batch norms of the running means: a process's own means would be of its scenes alone."""
    for layer in loss.modules():
        if isinstance(layer, nn.BatchNorm2d):
            layer.eval()


def gradients(loss):
    return {name: p.grad for name, p in loss.module.net.named_parameters() if p.requires_grad}


def steps(config, rank):
    """What two steps of the model showed this process."""
    whole = {k: views for k, views in make_batch(PROCESSES).items() if k != "scene"}
    own = {name: views.map(lambda tensor: tensor[rank, None]) for name, views in whole.items()}
    alone, loss = make_loss(config), make_loss(config)
    together = DistributedDataParallel(loss)
    optimizer = loss.module.configure_optimizers()["optimizer"]

    fixed_batch_norms(alone)
    alone(whole).backward()
    fixed_batch_norms(loss)
    together(own).backward()
    expected, found = gradients(alone), gradients(loss)
    missing = [name for name, grad in found.items() if grad is None]
    errors = {
        name: ((found[name] - grad).norm() / grad.norm().clamp_min(1e-12)).item()
        for name, grad in expected.items()
        if name not in missing
    }
    optimizer.step()
    # As in training; a process that still waits for a gradient of the first step raises here.
    loss.train()
    optimizer.zero_grad()
    together(own).backward()
    optimizer.step()
    weights = nn.utils.parameters_to_vector(loss.parameters()).detach()
    others = [torch.empty_like(weights) for _ in range(PROCESSES)]
    dist.all_gather(others, weights)
    return {
        "missing": missing,
        "errors": errors,
        "norm": nn.utils.get_total_norm(list(expected.values())).item(),
        "same": all(torch.equal(weights, other) for other in others),
        "finite": bool(weights.isfinite().all()),
    }


def process(rank, folder, configs):
    torch.set_num_threads(1)
    meeting = f"file://{folder}/meeting"
    dist.init_process_group("gloo", init_method=meeting, rank=rank, world_size=PROCESSES)
    results = {}
    for model, config in configs.items():
        try:
            results[model] = steps(config, rank)
        except RuntimeError as error:  # the other models' are still of interest
            results[model] = str(error)
    torch.save(results, f"{folder}/{rank}.pt")
    dist.destroy_process_group()


@pytest.fixture(scope="module")
def results(tmp_path_factory, composed):
    """What both processes found, by model; started once for all models."""
    folder = str(tmp_path_factory.mktemp("processes"))
    configs = {model: composed(f"model={model}", *OVERRIDES) for model in MODELS}
    mp.spawn(process, args=(folder, configs), nprocs=PROCESSES)
    return [torch.load(f"{folder}/{rank}.pt") for rank in range(PROCESSES)]


@pytest.mark.parametrize("model", MODELS)
def test_two_processes_take_the_step_of_one(results, model):
    """The gradient of both scenes, and then the same weights, in a step with batch norms too."""
    for result in (ranks[model] for ranks in results):
        assert isinstance(result, dict), result
        assert result["missing"] == []
        assert result["norm"] > 0 and result["errors"]
        worst = max(result["errors"], key=result["errors"].get)
        assert result["errors"][worst] < 1e-3, worst
        assert result["same"] and result["finite"]
