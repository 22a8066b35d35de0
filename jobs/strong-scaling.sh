#!/usr/bin/env bash
# Strong scaling: the same case on more and more ranks, one after another inside one job; ends with a table.
#
#   sbatch --nodes=4 --exclusive jobs/strong-scaling.sh
#   RANKS="1 2" bash jobs/strong-scaling.sh             on a workstation
#   DRY_RUN=1 bash jobs/strong-scaling.sh               only print the commands
#
# Without RANKS: 1, 2, 4, ... up to the tasks of the job. The table is of the times of the steps themselves, without
# the start (f2s_hpc/cli/timed_run.py). The kernels are compiled in a first short run on the most ranks.
#
# Particles are on the grid from the start: they land long after so short a time, and flight costs nothing.
#
# Variables: SCENE, CELL_SIZE, DURATION (simulated time), RANKS, OUT, and those of jobs/common.sh.
#SBATCH --job-name=f2s-strong
#SBATCH --nodes=1
#SBATCH --ntasks-per-node=32
#SBATCH --cpus-per-task=1
#SBATCH --exclusive
#SBATCH --time=04:00:00
#SBATCH --no-requeue
#SBATCH --open-mode=append
#SBATCH --output=%x-%j.log
set -euo pipefail

F2S_ROOT=${F2S_ROOT:-${SLURM_SUBMIT_DIR:-$(cd "$(dirname "$0")/.." && pwd)}}
. "$F2S_ROOT/jobs/common.sh"
[ $# -eq 0 ] || { echo "jobs/strong-scaling.sh: takes variables, no arguments; --help names them" >&2; exit 2; }
SCENE=${SCENE:-section4}
CELL_SIZE=${CELL_SIZE:-3 um}
DURATION=${DURATION:-100 ns}
OUT=${OUT:-runs/strong-scaling-${SLURM_JOB_ID:-local}}

scaling_study strong timed_run
