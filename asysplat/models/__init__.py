"""Networks from images to Gaussians: plain torch modules, each ablated part a component."""

from asysplat.models.asysplat import AsySplat, build_asysplat
from asysplat.models.attention import FullAttention, SparseAttention
from asysplat.models.head import GaussianHead, LongLRMHead, ResidualHead
from asysplat.models.layers import StageShape, Widths
from asysplat.models.links import (
    CoarseToFine,
    CoarseTokens,
    FineToCoarse,
    FineTokens,
    FusedTokens,
    NoLink,
)
from asysplat.models.mamba import BiMamba2, MambaVision
from asysplat.models.mvsplat import MVSplat
from asysplat.models.network import Prune
from asysplat.models.prior import PlaneSweep
from asysplat.models.single_branch import SingleBranch, build_single_branch

__all__ = [
    "AsySplat",
    "BiMamba2",
    "CoarseToFine",
    "CoarseTokens",
    "FineToCoarse",
    "FineTokens",
    "FullAttention",
    "FusedTokens",
    "GaussianHead",
    "LongLRMHead",
    "MVSplat",
    "MambaVision",
    "NoLink",
    "PlaneSweep",
    "Prune",
    "ResidualHead",
    "SingleBranch",
    "SparseAttention",
    "StageShape",
    "Widths",
    "build_asysplat",
    "build_single_branch",
]
