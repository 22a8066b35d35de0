"""f2s_hpc: MPI-parallel Eulerian simulation of cold-spray deposition."""

__version__ = "0.1.0"
