"""A trial of settings on small photographs, of which some sit out."""

from asysplat.data.selection import evenly_spaced
from asysplat.refinement.init import initial_gaussians, shrink_views, sweep
from asysplat.refinement.refine import refine
from asysplat.refinement.settings import RefinementSettings
from asysplat.rendering import render
from asysplat.scene import Views

TRIAL_VIEWS = range(8, 33)  # fewer photographs can spare none; of more, the default suits all
TRIAL_FROM = {"seconds": 60, "steps": 1000}  # of a refinement, of which a trial takes a twentieth
CLEAR_GAIN = 0.3  # dB: less, or less than its standard error, may be chance
SITTING_OUT = 4  # one photograph in so many: with one in eight two trials differ by up to .6 dB
SIDE = 64  # greatest side in pixels: of small photographs a short refinement ends as a long one
STEPS = 200  # of each refinement


def trial_gain(
    views: Views, settings: RefinementSettings, others: RefinementSettings, seed: int = 0
) -> tuple[float, float]:
    """Compute the gain in PSNR by other settings, in dB, of views that sit out a refinement.

    Returns the mean gain of these views, and its standard error.

    Args:
        views: the input views, [V], V in TRIAL_VIEWS; they stay as they are.
    """
    small = shrink_views(views, SIDE, multiple=1)
    count = views.num_views // SITTING_OUT
    sitting_out = evenly_spaced(range(views.num_views), count + 2)[1:-1]
    rest = small.select([view for view in range(views.num_views) if view not in sitting_out])
    target, background = small.select(sitting_out).decoded(), rest.color_behind(rest.mean_color())
    estimate, errors = sweep(rest), []
    for tried in (settings, others):
        start = initial_gaussians("plane_sweep", rest, tried.initial_limit, estimate=estimate)
        refined = refine(
            start, rest, tried, steps=STEPS, background=background, seed=seed, estimate=estimate
        )
        image = render(refined, target.cameras, background, masks=target.masks).image
        errors.append((target.masked(image) - target.images).square().mean((-3, -2, -1)))
    gains = 10 * (errors[0] / errors[1]).log10()
    return gains.mean().item(), gains.std().item() / count**0.5
