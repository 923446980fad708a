"""Steps of the optimizer: which parameters decay or train, the learning rate, new tasks."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from test_checkpoints import Numbers
from tiny import OneLayer

from asysplat.evaluation.static_cost import blank_views
from asysplat.scene import Cameras, Views
from asysplat.training import SplattingLoss, SplattingModule
from asysplat.training.optimizers import cosine

PARTS = ("asysplat", "blocks", "one_branch")  # shared by the files of the models
UNTRAINED = ("plane_sweep",)
FOLDER = Path(__file__).parents[2] / "conf" / "model"
MODELS = sorted(path.stem for path in FOLDER.glob("*.yaml") if path.stem not in PARTS + UNTRAINED)


def make_module(net, background=(0.5, 0.5, 0.5), warmup_steps=1, total_steps=2, **options):
    options = {"lr": 1e-3, "weight_decay": 0.05, "fused": True} | options
    return SplattingModule(
        net=net,
        loss=SplattingLoss(mse=1.0, perceptual=0.0, depth=0.0),
        optimizer=partial(torch.optim.AdamW, **options),
        schedule=partial(cosine, warmup_steps=warmup_steps, total_steps=total_steps),
        background=background,
    )


UNREAD = {"asysplat_pred_coarse": "appearance.links.2.", "asysplat_pred_fine": "geometry.links.2."}


@pytest.mark.medium
@pytest.mark.parametrize("model", MODELS)
def test_which_parameters_are_trained_and_which_decay(build, model):
    module = make_module(build("width=0.125", "state_size=8", f"model={model}", device="meta"))
    named = dict(module.net.named_parameters())
    unread = {name for name in named if name.startswith(UNREAD.get(model, "none"))}
    assert {name for name, p in named.items() if not p.requires_grad} == unread
    assert bool(unread) == (model in UNREAD)

    names = {parameter: name for name, parameter in named.items()}
    groups = module.configure_optimizers()["optimizer"].param_groups
    assert [group["weight_decay"] for group in groups] == [0.05, 0.0]
    decaying, steady = ([names[p] for p in group["params"]] for group in groups)
    assert set(decaying) | set(steady) == set(named) - unread and decaying and steady
    # By name, which the code does not look at.
    for name in decaying:
        learned = name == "global_tokens"
        assert learned or (name.endswith(".weight") and "norm" not in name), name
    assert "global_tokens" not in steady
    modules = dict(module.net.named_modules())
    for name in steady:
        kind = type(modules[name.rpartition(".")[0]]).__name__
        assert not name.endswith(".weight") or "Norm" in kind, name


@pytest.mark.medium
@pytest.mark.parametrize(
    ("algorithm", "measure"), [("norm", torch.linalg.vector_norm), ("value", torch.amax)]
)
def test_gradients_are_clipped(build, algorithm, measure):
    module = make_module(build("width=0.125", "state_size=8"))
    optimizer = module.configure_optimizers()["optimizer"]
    for parameter in module.parameters():
        parameter.grad = torch.full_like(parameter, 3.0)
    module.configure_gradient_clipping(optimizer, 0.5, algorithm)
    grads = torch.cat([p.grad.flatten().double() for p in module.parameters()])
    torch.testing.assert_close(measure(grads), torch.tensor(0.5).double(), rtol=1e-5, atol=0)


@pytest.mark.medium
@pytest.mark.parametrize(("norm", "dropped"), [(2.4, False), (2.6, True)])
def test_a_step_with_a_gradient_above_5_times_the_clip_changes_nothing(build, norm, dropped):
    module = make_module(build("width=0.125", "state_size=8"))
    module.drop_above = 5.0
    optimizer = module.configure_optimizers()["optimizer"]
    count = sum(parameter.numel() for parameter in module.parameters())
    for parameter in module.parameters():
        parameter.grad = torch.full_like(parameter, norm / math.sqrt(count))
    before = [parameter.detach().clone() for parameter in module.parameters()]
    module.configure_gradient_clipping(optimizer, 0.5, "norm")
    optimizer.step()
    same = [torch.equal(a, b) for a, b in zip(before, module.parameters(), strict=True)]
    assert all(same) if dropped else not any(same)


@pytest.mark.medium
def test_the_background_follows_the_inputs(build):
    """What no Gaussian covers has the mean color of each scene's inputs."""
    module = make_module(build("width=0.125", "state_size=8"), "inputs")
    poses = torch.eye(4).repeat(2, 2, 1, 1)
    intrinsics = torch.tensor([[32.0, 0, 16], [0, 32, 16], [0, 0, 1]]).repeat(2, 2, 1, 1)
    inputs = Views(Cameras(intrinsics, poses, 32, 32), torch.rand(2, 2, 3, 32, 32))
    away = poses[:, :1] * torch.tensor([-1.0, 1, -1, 1])  # turned round
    targets = Views(Cameras(intrinsics[:, :1], away, 32, 32), torch.rand(2, 1, 3, 32, 32))
    batch = {"inputs": inputs, "targets": targets}
    inputs.images[1] = 0.4 * inputs.images[1]
    trained = module.train()(batch, depth=False).rendering.image
    assert set(trained[0].unique().tolist()) <= {0, 1} and (trained[1] == 1).all()
    prediction = module.eval()(batch, depth=False)
    expected = inputs.images.mean((1, 3, 4))[:, None, :, None, None].expand(2, 1, 3, 32, 32)
    torch.testing.assert_close(prediction.rendering.image, expected)
    alphas = torch.ones(2, 2, 32, 32)
    alphas[0, :, :4] = 0
    inputs.images[0, :, :, :4] = 0.25
    batch["inputs"] = replace(inputs, alphas=alphas)
    assert (module(batch, depth=False).rendering.image[0] == 0.25).all()
    trained = module.train()(batch, depth=False).rendering.image
    assert (trained[0] == 0.25).all() and (trained[1] == 1).all()


def rates(warmup_steps, total_steps, steps):
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=0.4)
    schedule = cosine(optimizer, warmup_steps, total_steps)
    found = []
    for _ in range(steps):
        found += schedule.get_last_lr()
        optimizer.step()
        schedule.step()
    return found


def test_linear_warm_up_then_a_cosine_to_zero():
    found = rates(warmup_steps=4, total_steps=12, steps=15)
    assert found[:5] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.4])
    assert found[6] == pytest.approx(0.2 * (1 + math.cos(math.pi / 4)))
    assert found[8] == pytest.approx(0.2) and found[12:] == [0.0, 0.0, 0.0]
    # Without a warm-up, and with one of the whole training.
    assert rates(warmup_steps=0, total_steps=3, steps=3) == pytest.approx([0.4, 0.3, 0.1])
    assert rates(warmup_steps=2, total_steps=2, steps=3) == pytest.approx([0.2, 0.4, 0.4])


STEPS = 6


class TaskRecorder(OneLayer):
    def __init__(self):
        super().__init__()
        self.read = []

    def training_step(self, batch, index):
        self.read.append(int(batch))
        return super().training_step(batch, index)


def test_no_task_comes_twice(composed, tmp_path):
    config = composed("trainer=cpu", f"steps={STEPS}").trainer
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    module = TaskRecorder()
    instantiate(config, default_root_dir=tmp_path, **quiet).fit(module, Numbers())
    assert module.read == list(range(STEPS))


@pytest.mark.medium
def test_a_batch_says_whether_its_gaussians_are_pruned(build):
    """Table 3: none is pruned on Replica, whatever the model does elsewhere."""
    module = make_module(build("width=0.125", "state_size=8", "model=longlrm", "stage=stage3"))
    views = blank_views(2, 32, 32).map(torch.zeros_like)
    views.cameras.intrinsics[:] = torch.tensor([[50.0, 0, 16], [0, 50, 16], [0, 0, 1]])
    views.cameras.cam_to_world[:] = torch.eye(4)
    batch = {"inputs": views, "targets": views}

    def rendered(**options):
        with torch.no_grad():
            return module.eval()(batch | options, depth=True).rendering.alpha

    pruned, unpruned = rendered(), rendered(prune=False)
    assert pruned.sum() < unpruned.sum() and torch.equal(pruned, rendered(prune=True))
    module.net.prune = None
    assert torch.equal(unpruned, rendered())
