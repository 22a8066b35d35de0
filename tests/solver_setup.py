"""Small boxes for the tests of kernels and solver: those of the verification cases."""

from f2s_hpc.verify.box import *  # noqa: F403
