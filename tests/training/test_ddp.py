"""Two processes that train together take the steps of one process on both their scenes."""

from pathlib import Path

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from asysplat.scene import Cameras, Views

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

CONF = Path(__file__).parents[2] / "conf"
PARTS = ("asysplat", "blocks", "one_branch")  # shared by the files of the models
MODELS = sorted(p.stem for p in (CONF / "model").glob("*.yaml") if p.stem not in PARTS)
OVERRIDES = ["width=0.125", "state_size=8", "training.loss.depth=0", "training.loss.perceptual=0"]
SIZE, INPUTS, TARGETS, PROCESSES = 32, 2, 1, 2


def make_batch():
    """A scene for each process: noise seen from a line of cameras."""
    views = INPUTS + TARGETS
    pose = torch.eye(4).repeat(PROCESSES, views, 1, 1)
    pose[..., 0, 3] = torch.linspace(-1, 1, views)
    intrinsics = torch.tensor([[30.0, 0, SIZE / 2], [0, 30.0, SIZE / 2], [0, 0, 1]])
    cameras = Cameras(intrinsics.repeat(PROCESSES, views, 1, 1), pose, SIZE, SIZE)
    images = torch.rand(PROCESSES, views, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    every = Views(cameras, images)
    return {"inputs": every.select(range(INPUTS)), "targets": every.select(range(INPUTS, views))}


class Loss(nn.Module):
    """A batch's loss, as the forward pass that DistributedDataParallel waits for."""

    def __init__(self, module):
        super().__init__()
        self.module = module

    def forward(self, batch):
        prediction = self.module(batch, depth=self.module.loss.needs_depth)
        return self.module.loss(prediction, batch)["loss"]


def make_loss(model):
    """The same weights in every process."""
    with initialize_config_dir(str(CONF), version_base=None):
        config = compose("train", [f"model={model}", *OVERRIDES])
    torch.manual_seed(0)
    return Loss(instantiate(config.training, net=instantiate(config.model)))


def fixed_batch_norms(loss):
    """Batch norms of the running means: a process's own means would be of its scenes alone."""
    for layer in loss.modules():
        if isinstance(layer, nn.BatchNorm2d):
            layer.eval()


def gradients(loss):
    return {name: p.grad for name, p in loss.module.net.named_parameters() if p.requires_grad}


def steps(model, rank):
    """What two steps of the model showed this process."""
    whole = make_batch()
    own = {name: views.map(lambda tensor: tensor[rank, None]) for name, views in whole.items()}
    alone, loss = make_loss(model), make_loss(model)
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


def process(rank, folder):
    torch.set_num_threads(1)
    meeting = f"file://{folder}/meeting"
    dist.init_process_group("gloo", init_method=meeting, rank=rank, world_size=PROCESSES)
    results = {}
    for model in MODELS:
        try:
            results[model] = steps(model, rank)
        except RuntimeError as error:  # the other models' are still of interest
            results[model] = str(error)
    torch.save(results, f"{folder}/{rank}.pt")
    dist.destroy_process_group()


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """What both processes found, by model; started once for all models."""
    folder = str(tmp_path_factory.mktemp("processes"))
    mp.spawn(process, args=(folder,), nprocs=PROCESSES)
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


def first_moments(train, *overrides):
    """Train; return AdamW's running means of the gradients after the last step."""
    batches = ["model=asysplat_pred_fine", "model.layers=1m1t"]
    result = train.alone(*batches, *overrides)
    assert result.returncode == 0, result.stderr
    (line,) = [line for line in result.stdout.splitlines() if line.startswith("run: ")]
    path = Path(line.removeprefix("run: ")) / "checkpoints" / "last.ckpt"
    states = torch.load(path, weights_only=True)["optimizer_states"][0]["state"]
    return torch.cat([states[key]["exp_avg"].flatten() for key in sorted(states)])


def test_the_script_with_two_devices(train):
    """The run of one process on the same batches."""
    two = first_moments(train, "name=two", "trainer.devices=2", "data.batch_size=2")
    one = first_moments(train, "name=one", "trainer.devices=1", "data.batch_size=2")
    other = first_moments(train, "name=other", "trainer.devices=1", "data.batch_size=1")
    assert (two - one).norm() < 1e-4 * one.norm() < 1e-3 * (other - one).norm()
