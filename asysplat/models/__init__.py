"""Networks from images to Gaussians: plain torch modules, each ablated part a component."""

from asysplat.models.asysplat import AsySplat, build_asysplat
from asysplat.models.attention import FullAttention, SparseAttention
from asysplat.models.bilateral import CoarseToFine, FineToCoarse, NoLink
from asysplat.models.early_exit import EarlyExit
from asysplat.models.fusion import CoarseTokens, FineTokens, FusedTokens
from asysplat.models.head import GaussianHead, LongLRMHead, ResidualHead
from asysplat.models.mamba2 import BiMamba2
from asysplat.models.mamba_vision import MambaVision
from asysplat.models.mvsplat import MVSplat
from asysplat.models.prior import DepthPrior, PlaneSweepPrior, PointsPrior
from asysplat.models.prune import Prune
from asysplat.models.shapes import StageShape, Widths
from asysplat.models.single_branch import SingleBranch, build_single_branch

__all__ = [
    "AsySplat",
    "BiMamba2",
    "CoarseToFine",
    "CoarseTokens",
    "DepthPrior",
    "EarlyExit",
    "FineToCoarse",
    "FineTokens",
    "FullAttention",
    "FusedTokens",
    "GaussianHead",
    "LongLRMHead",
    "MVSplat",
    "MambaVision",
    "NoLink",
    "PlaneSweepPrior",
    "PointsPrior",
    "Prune",
    "ResidualHead",
    "SingleBranch",
    "SparseAttention",
    "StageShape",
    "Widths",
    "build_asysplat",
    "build_single_branch",
]
