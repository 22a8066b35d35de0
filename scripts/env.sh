# Prepare a shell for f2s:  . scripts/env.sh
# Puts f2s on PATH and lets mpirun start more ranks than cores, and as root. Values already set stay.

if [ -n "${BASH_VERSION:-}" ]; then
    F2S_ROOT=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
elif [ -n "${ZSH_VERSION:-}" ]; then
    F2S_ROOT=$(cd "$(dirname "${(%):-%x}")/.." && pwd)
elif [ -z "${F2S_ROOT:-}" ]; then
    F2S_ROOT=$(pwd)
fi
export F2S_ROOT

case ":$PATH:" in
    *":$F2S_ROOT/.venv/bin:"*) ;;
    *) export PATH="$F2S_ROOT/.venv/bin:$PATH" ;;
esac

if [ -z "${PETSC_DIR:-}" ]; then
    for folder in /usr/lib/petscdir/petsc*/*-real; do
        [ -d "$folder/lib/python3/dist-packages/petsc4py" ] && export PETSC_DIR="$folder"
    done
    unset folder
fi
export H5PY_ALWAYS_USE_MPI="${H5PY_ALWAYS_USE_MPI:-1}"
# All parallelism is in the ranks.
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"
export OMPI_MCA_rmaps_base_oversubscribe="${OMPI_MCA_rmaps_base_oversubscribe:-1}"
# Open MPI binds the ranks of each run from core 0 on, so that two runs side by side would share it. In a batch job, which
# has its cores for itself, binding is right.
if [ -z "${SLURM_JOB_ID:-}${PBS_JOBID:-}${LSB_JOBID:-}" ]; then
    export OMPI_MCA_hwloc_base_binding_policy="${OMPI_MCA_hwloc_base_binding_policy:-none}"
fi
if [ "$(id -u)" = 0 ]; then
    export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
fi
