"""The equations of rigid mirrors, which all their solvers share."""

from rfpose.multilat.equations._kernels import Mirrors, Prior, rotate

__all__ = ["Mirrors", "Prior", "rotate"]
