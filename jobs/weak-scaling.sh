#!/usr/bin/env bash
# Weak scaling: the patch grows with the ranks, so that each has the same work; ends with a table.
#
#   sbatch --nodes=4 --exclusive jobs/weak-scaling.sh
#   RANKS="1 2" bash jobs/weak-scaling.sh             on a workstation
#   DRY_RUN=1 bash jobs/weak-scaling.sh               only print the commands
#
# Each rank gets a column of PATCH_MM x PATCH_MM of the deposit over the whole height of the box, with its share
# of particles; the patch grows along x and y in turn. The table is of the times of the steps themselves, without the
# start (f2s_hpc/cli/timed_run.py). The kernels are compiled in a first short run on the most ranks.
#
# Particles are on the grid from the start: they land long after so short a time, and flight costs nothing.
#
# Variables: SCENE, CELL_SIZE, DURATION (simulated time), PATCH_MM, HEIGHT_MM, PARTICLES (for each rank), RANKS,
# OUT, and those of jobs/common.sh.
#SBATCH --job-name=f2s-weak
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
[ $# -eq 0 ] || { echo "jobs/weak-scaling.sh: takes variables, no arguments; --help names them" >&2; exit 2; }
SCENE=${SCENE:-section4}
CELL_SIZE=${CELL_SIZE:-3 um}
DURATION=${DURATION:-100 ns}
PATCH_MM=${PATCH_MM:-0.12}
HEIGHT_MM=${HEIGHT_MM:-0.6}
# The paper's 500 on 0.35 x 0.35 mm, as many on each square millimetre.
PARTICLES=${PARTICLES:-$(awk -v side="$PATCH_MM" 'BEGIN { printf "%.0f", 500 * (side / 0.35) ^ 2 }')}
OUT=${OUT:-runs/weak-scaling-${SLURM_JOB_ID:-local}}

# patch_size RANKS: domain.size for a patch of RANKS columns, as square as it goes.
patch_size() {
    awk -v ranks="$1" -v side="$PATCH_MM" -v height="$HEIGHT_MM" 'BEGIN {
        for (y = int(sqrt(ranks)); ranks % y; y--);
        printf "[\"%.6g mm\", \"%.6g mm\", \"%.6g mm\"]", ranks / y * side, y * side, height
    }'
}

# patch_run RANKS FOLDER DURATION: timed_run of the patch for so many ranks.
patch_run() {
    timed_run "$@" --set "domain.size=$(patch_size "$1")" --set "batches.particles=$((PARTICLES * $1))" \
        --set batches.count=1
}

scaling_study weak patch_run
