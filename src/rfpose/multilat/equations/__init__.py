"""The equations of rigid mirrors, which all their solvers share."""

from rfpose.multilat.equations._kernels import MirrorArrays, MirrorPrior, rotate

__all__ = ["MirrorArrays", "MirrorPrior", "rotate"]
